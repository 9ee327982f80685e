// p and beta by Pinocchio's matrices: p = M dq, beta = g - C^T dq.
#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/serialization.hpp>

#include "timed_states.hpp"

int main(int argc, char** argv) {
  if (argc != 7) return 2;
  pinocchio::Model model;
  model.loadFromText(argv[1]);
  pinocchio::Data data(model);
  const long n = model.nv;
  return run_timed(argv, [&](const double* q_in, const double* dq_in, double* p, double* beta) {
    const Eigen::Map<const Eigen::VectorXd> q(q_in, n), dq(dq_in, n);
    Eigen::Map<Eigen::VectorXd> p_out(p, n), beta_out(beta, n);
    pinocchio::crba(model, data, q, pinocchio::Convention::LOCAL);
    p_out.noalias() = data.M.selfadjointView<Eigen::Upper>() * dq;
    pinocchio::computeCoriolisMatrix(model, data, q, dq);
    pinocchio::computeGeneralizedGravity(model, data, q);
    beta_out = data.g;
    beta_out.noalias() -= data.C.transpose() * dq;
  });
}
