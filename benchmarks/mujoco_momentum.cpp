// p and beta by MuJoCo: p = M dq; it has no matrix C, so beta = C dq + g - (dM/dt) dq, with dM/dt from p 0.1 ms earlier
// and later.
#include <mujoco/mujoco.h>

#include "timed_states.hpp"

int main(int argc, char** argv) {
  if (argc != 7) return 2;
  mjModel* model = mj_loadModel(argv[1], nullptr);
  if (!model) return 1;
  mjData* data = mj_makeData(model);
  const int n = model->nv;
  std::vector<double> before(n), after(n);
  const auto momentum_at = [&](const double* q, const double* dq, double shift_s, double* p) {
    for (int i = 0; i < n; ++i) data->qpos[i] = q[i] + shift_s * dq[i];
    mj_kinematics(model, data);
    mj_comPos(model, data);
    mj_makeM(model, data);
    mj_mulM(model, data, p, dq);
  };
  const int status = run_timed(argv, [&](const double* q, const double* dq, double* p, double* beta) {
    constexpr double kShift = 1e-4;
    momentum_at(q, dq, -kShift, before.data());
    momentum_at(q, dq, kShift, after.data());
    momentum_at(q, dq, 0.0, p);
    std::copy(dq, dq + n, data->qvel);
    mj_comVel(model, data);
    mj_rne(model, data, 0, beta);
    for (int i = 0; i < n; ++i) beta[i] -= (after[i] - before[i]) / (2 * kShift);
  });
  mj_deleteData(data);
  mj_deleteModel(model);
  return status;
}
