/* tauext.h as a C program sees it; c_api_test.cpp calls this and compares. */
#include "tauext/tauext.h"

_Static_assert(sizeof(((tauext_estimate*)0)->tau_ext) == TAUEXT_MAX_JOINTS * sizeof(double), "a value for each joint");

int estimates_of_c_program(const void* bundle, size_t bundle_size, size_t samples, const double* q, const double* dq,
                           const double* tau, double* tau_ext, int32_t* alarms);

/* Steps a monitor of the bundle through samples of one period; 0 where all went well, else the line that did not. */
int estimates_of_c_program(const void* bundle, size_t bundle_size, size_t samples, const double* q, const double* dq,
                           const double* tau, double* tau_ext, int32_t* alarms) {
  tauext_monitor* monitor = NULL;
  tauext_estimate e = {.size = sizeof e};
  char message[64];
  if (tauext_monitor_open_bytes(bundle, bundle_size, TAUEXT_EVERY_SAMPLE, &monitor, message, sizeof message) != TAUEXT_OK)
    return __LINE__;
  const size_t joints = (size_t)tauext_monitor_joints(monitor);
  const int64_t period_ns = tauext_monitor_sample_period_ns(monitor);
  for (size_t k = 0; k < samples; ++k) {
    const size_t at = k * joints;
    if (tauext_monitor_estimate(monitor, (int64_t)k * period_ns, q + at, dq + at, tau + at, &e) != TAUEXT_OK)
      return __LINE__;
    if (tauext_monitor_advance(monitor) != TAUEXT_OK) return __LINE__;
    for (size_t j = 0; j < joints; ++j) tau_ext[at + j] = e.tau_ext[j];
    alarms[k] = e.alarm;
  }
  tauext_monitor_close(monitor);
  return 0;
}
