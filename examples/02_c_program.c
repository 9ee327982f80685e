/* The monitor from C:   02_c_program ARM.tauext < SAMPLES.csv   or, without samples,   02_c_program ARM.tauext SECONDS
 *
 * A line of SAMPLES.csv is t_ns,q...,dq...,tau..., a value for each joint; a header is passed over. With SECONDS a smooth
 * made-up motion is fed instead. tau is in the unit that stands in the first line. Prints a line whenever health or
 * alarm changes, and in the end the last torques. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "tauext/tauext.h"

enum { q, dq, tau, signals };
typedef struct sample {
  int64_t t_ns;
  double values[signals][TAUEXT_MAX_JOINTS];
} sample;

static int read_values(const char** at, double* values, int joints) {
  for (int j = 0; j < joints; ++j) {
    char* end;
    if (**at != ',') return 0;
    values[j] = strtod(*at + 1, &end);
    if (end == *at + 1) return 0;
    *at = end;
  }
  return 1;
}

/* 1: a sample; 0: the end; -1: a line that is none. */
static int read_sample(sample* s, int joints) {
  static char line[64 * (3 * TAUEXT_MAX_JOINTS + 1)];
  while (fgets(line, sizeof line, stdin)) {
    if (line[0] != '-' && (line[0] < '0' || line[0] > '9')) continue;
    char* end;
    s->t_ns = strtoll(line, &end, 10);
    const char* at = end;
    for (int signal = q; signal < signals; ++signal)
      if (!read_values(&at, s->values[signal], joints)) return -1;
    return *at == '\n' || *at == '\r' || *at == '\0' ? 1 : -1;
  }
  return 0;
}

static void make_sample(sample* s, int joints, int64_t t_ns) {
  const double t = 1e-9 * (double)t_ns;
  s->t_ns = t_ns;
  for (int j = 0; j < joints; ++j) {
    const double speed = 1.0 + 0.3 * j;
    s->values[q][j] = 0.5 * sin(speed * t);
    s->values[dq][j] = 0.5 * speed * cos(speed * t);
    s->values[tau][j] = 2.0 * s->values[dq][j];
  }
}

static void print_change(const tauext_monitor* monitor, const tauext_estimate* e) {
  printf("%.3f s: health %s, alarm %s", 1e-9 * (double)e->t_ns, tauext_health_name(e->health),
         tauext_alarm_name(e->alarm));
  if (e->alarm_joint >= 0)
    printf(" on %s (tau_ext %.1f %s)", tauext_monitor_joint_name(monitor, e->alarm_joint), e->tau_ext[e->alarm_joint],
           tauext_monitor_estimate_unit(monitor, e->alarm_joint));
  for (uint32_t bit = 1; bit != 0; bit <<= 1)
    if (e->causes & bit) printf(", %s", tauext_cause_name(bit));
  printf("\n");
}

int main(int argc, char** argv) {
  const double seconds = argc > 2 ? atof(argv[2]) : 0.0;
  if (argc < 2 || argc > 3 || !(seconds >= 0 && seconds <= 86400)) {
    fprintf(stderr, "usage: 02_c_program ARM.tauext < SAMPLES.csv, or 02_c_program ARM.tauext SECONDS\n");
    return 2;
  }
  tauext_monitor* monitor;
  char message[256];
  if (tauext_monitor_open(argv[1], TAUEXT_EVERY_SAMPLE, &monitor, message, sizeof message) != TAUEXT_OK) {
    fprintf(stderr, "%s\n", message);
    return 2;
  }
  const int joints = tauext_monitor_joints(monitor);
  const int64_t period_ns = tauext_monitor_sample_period_ns(monitor);
  printf("tau in");
  for (int j = 0; j < joints; ++j) printf(" %s", tauext_monitor_torque_unit(monitor, j));
  printf("\n");
  sample s;
  tauext_estimate e = {.size = sizeof e};
  int32_t health = -1, alarm = -1, got = 1;
  long long samples = 0;
  for (; argc > 2 ? 1e-9 * (double)(samples * period_ns) < seconds : (got = read_sample(&s, joints)) == 1; ++samples) {
    if (argc > 2) make_sample(&s, joints, samples * period_ns);
    /* No check: a bad signal is no error of the call, it is answered in e.health. */
    tauext_monitor_step(monitor, s.t_ns, s.values[q], s.values[dq], s.values[tau], &e);
    if (e.health != health || e.alarm != alarm) print_change(monitor, &e);
    health = e.health;
    alarm = e.alarm;
  }
  if (got < 0) fprintf(stderr, "line after sample %lld: t_ns and %d values belong there\n", samples, 3 * joints);
  printf("%lld samples; tau_ext", samples);
  for (int j = 0; j < joints; ++j) printf(" %.17g", samples ? e.tau_ext[j] : 0.0);
  printf("\n");
  tauext_monitor_close(monitor);
  return got < 0 ? 2 : 0;
}
