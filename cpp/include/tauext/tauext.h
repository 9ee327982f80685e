/* The monitor for C and whatever calls C: an opaque handle, status codes, no exception across it.
 *
 *   tauext_monitor* monitor;
 *   char message[256];
 *   if (tauext_monitor_open("arm.tauext", TAUEXT_EVERY_SAMPLE, &monitor, message, sizeof message) != TAUEXT_OK) ...
 *   tauext_estimate e = {.size = sizeof e};
 *   tauext_monitor_step(monitor, t_ns, q, dq, tau, &e);      every sample period
 *
 * A torque is positive where it pushes the joint in its positive direction; tau is the motor's torque on the joint's
 * side of the gear. A null pointer where something belongs is TAUEXT_BAD_ARGUMENT, unless documented as allowed.
 * tauext_monitor_estimate, _advance, _step, _no_sample, _acknowledge, _resume, _set_limit_factors, _set_load,
 * _clear_load, _expect_load, _reset, _save_state and _restore_state do not allocate, lock, log or call the system. One
 * thread at a time for each monitor. */
#ifndef TAUEXT_H
#define TAUEXT_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define TAUEXT_MAX_JOINTS 32 /* that an arm may have, and that arrays of an estimate hold */

/* What became of a call. */
typedef enum tauext_status {
  TAUEXT_OK = 0,
  TAUEXT_BAD_ARGUMENT = 1, /* a null pointer, a size that does not fit */
  TAUEXT_BAD_BUNDLE = 2,   /* the message contains the reason */
  TAUEXT_NO_MEMORY = 3,    /* the monitor could not be made */
  TAUEXT_BAD_STATE = 4,    /* of another monitor, or damaged */
  TAUEXT_BAD_LOAD = 5      /* tauext_monitor_why_no_load writes the reason */
} tauext_status;

/* When the network answers: at every sample, or, for slow processors, once in its own period (about 10 ms). */
typedef enum tauext_network_rate { TAUEXT_EVERY_SAMPLE = 0, TAUEXT_NETWORK_PERIOD = 1 } tauext_network_rate;

/* Whether the torques of an estimate can be trusted. */
typedef enum tauext_health {
  TAUEXT_WARMING_UP = 0, /* there is no estimate yet */
  TAUEXT_HEALTHY = 1,    /* they can */
  TAUEXT_STALE = 2,      /* the last estimate is held */
  TAUEXT_FAULT = 3       /* the signals cannot be true or cannot be used */
} tauext_health;

/* A contact falls back by itself; a collision stays until it is acknowledged. */
typedef enum tauext_alarm { TAUEXT_NO_ALARM = 0, TAUEXT_CONTACT = 1, TAUEXT_COLLISION = 2 } tauext_alarm;

/* Bits of tauext_estimate.causes: why health is not healthy, or was not when the warm-up began. */
typedef enum tauext_cause {
  TAUEXT_NOT_FINITE = 1,             /* NaN or infinity in q, dq or tau, or too large a number */
  TAUEXT_WRONG_SIZE = 2,             /* not one value a joint; not possible from C */
  TAUEXT_LATE_SAMPLE = 4,            /* older than the newest, by no more than is bridged: left out */
  TAUEXT_TIME_BACKWARDS = 8,         /* older by more: the clock was set back */
  TAUEXT_MISSING_SAMPLE = 16,        /* none came for as long as is bridged at most */
  TAUEXT_GAP = 32,                   /* none came for longer */
  TAUEXT_WRONG_RATE = 64,            /* the samples' mean step is not the bundle's */
  TAUEXT_TORQUE_SATURATED = 128,     /* a drive at its limit gives another torque than commanded */
  TAUEXT_ENCODER_STILL = 256,        /* a position stands still while velocity or torque indicate motion */
  TAUEXT_IMPOSSIBLE_TORQUE = 512,    /* more than the drive can give */
  TAUEXT_IMPOSSIBLE_VELOCITY = 1024, /* faster than the joint can get */
  TAUEXT_IMPOSSIBLE_POSITION = 2048  /* farther from the last position than the joint can have gone */
} tauext_cause;

typedef enum tauext_load_phase {
  TAUEXT_NO_LOAD_EXPECTED = 0,
  TAUEXT_EXPECTING_LOAD = 1, /* nothing has shown yet */
  TAUEXT_DECIDING_LOAD = 2,  /* an alarm is held back: what shows fits a load */
  TAUEXT_LOAD_FOUND = 3,     /* one was set; more of it is taken until the window ends */
  TAUEXT_WEIGHING_LOAD = 4   /* the window is over and nothing is held back; the load is weighed on */
} tauext_load_phase;

typedef enum tauext_touch {
  TAUEXT_NO_TOUCH = 0,      /* no alarm stands */
  TAUEXT_UNKNOWN_TOUCH = 1, /* not decided yet, or none of the others */
  TAUEXT_IMPACT = 2,        /* it came and went within a bounce */
  TAUEXT_PUSH = 3,          /* it yields */
  TAUEXT_CLAMP = 4,         /* it does not: the torque grows as the arm goes on, or on and on while it stands */
  TAUEXT_LOAD_TOUCH = 5     /* a weight at the load frame */
} tauext_touch;

/* The monitor's estimate at one sample. A torque that does not exist is NaN. Only (health == TAUEXT_HEALTHY &&
 * alarm == TAUEXT_NO_ALARM) may be read as "no collision". */
typedef struct tauext_estimate {
  size_t size; /* set by the caller: sizeof(tauext_estimate), at least up to `residual`; no more is written */
  int64_t t_ns;           /* stamp of the sample */
  int32_t joints;         /* so many numbers of each array count */
  int32_t health;         /* tauext_health */
  uint32_t causes;        /* bits of tauext_cause */
  int32_t cause_joint;    /* the first joint that a cause concerns; -1: none */
  int32_t alarm;          /* tauext_alarm, latched */
  int32_t alarm_joint;    /* that raised the alarm to its level; -1: none */
  int64_t alarm_t_ns;     /* when it did */
  int32_t detection;      /* 1: some |tau_ext| over its collision limit, at this sample */
  uint32_t near_stiction; /* a bit a joint: it sticks or creeps, so that its limit near stiction holds */
  double residual[TAUEXT_MAX_JOINTS];    /* [N m], r of the observer */
  double uncertainty[TAUEXT_MAX_JOINTS]; /* [N m], r expected in free motion: prior, network and drift */
  double tau_ext[TAUEXT_MAX_JOINTS];     /* [N m], residual - uncertainty */
  double limit_nm[TAUEXT_MAX_JOINTS];    /* that |tau_ext| must exceed for a collision */
  double margin_nm[TAUEXT_MAX_JOINTS];   /* limit - |tau_ext| */
  double drift[TAUEXT_MAX_JOINTS];       /* [N m], part of uncertainty: slow changes since training */
  uint32_t drift_saturated;              /* a bit a joint: drift at its bound, retrain; health stays as it is */
  uint32_t unused;                       /* 0 */
  double sigma_nm[TAUEXT_MAX_JOINTS];    /* [N m], standard error of tau_ext as the motion announces it; NaN: unknown */
  double unfamiliar;                     /* distance of the motion from all training motion: 0 to 1, reported from 0.5 on */
  double load_kg;                        /* that the arm is taken to carry; 0: nothing */
  int32_t load_phase;                    /* tauext_load_phase */
  int32_t touch;                         /* tauext_touch: what kind of touch the alarm is */
  int64_t load_found_ns;                 /* sample at which the last load that was expected was found; 0: none */
  double load_error_kg;                  /* standard error of its mass */
  double load_nm[TAUEXT_MAX_JOINTS];     /* [N m], what of tau_ext is taken for a load that is expected */
  double contact_sigma_nm[TAUEXT_MAX_JOINTS]; /* [N m], sigma_nm, but larger from a contact on until the joint slides */
} tauext_estimate;

/* What the arm carries beside its own links, in the axes of tauext_monitor_load_frame(). */
typedef struct tauext_load {
  double mass;        /* [kg]; 0: nothing */
  double com[3];      /* centre of mass in the load frame, [m] */
  double inertia[6];  /* about the centre of mass: xx, yy, zz, xy, xz, yz, [kg m^2]; zeros: a point */
  double error_share; /* limits rise by this share of its torques; TAUEXT_USUAL_LOAD_ERROR, 0: it is known exactly */
} tauext_load;

#define TAUEXT_USUAL_LOAD_ERROR 0.03
#define TAUEXT_FROM_NOW INT64_MAX /* for since_ns: from the next sample on */

/* What was weighed. */
typedef enum tauext_load_verdict {
  TAUEXT_TOO_LITTLE_MOTION = 0, /* three tenths of a second are the least */
  TAUEXT_NO_LOAD_SHOWS = 1,
  TAUEXT_LOAD_SHOWS = 2,
  TAUEXT_CONTACT_FITS_BETTER = 3, /* a constant force does: something touches the arm */
  TAUEXT_PULLS_UP = 4,
  TAUEXT_LOAD_UNCLEAR = 5         /* neither explains it */
} tauext_load_verdict;

/* Numbers without `load` are of what there is beside the load that is set; lengths and axes of the load frame. */
typedef struct tauext_load_found {
  size_t size;               /* set by the caller: sizeof(tauext_load_found); no more is written */
  int32_t verdict;           /* tauext_load_verdict */
  int32_t mass_seen;         /* 0: the motion does not separate the mass from its lever */
  tauext_load load;          /* both together, for tauext_monitor_set_load */
  double mass_kg;            /* below 0 only where a load is set, which is less then */
  double mass_error_kg;      /* standard error */
  double com_m[3];           /* centre of mass */
  double com_error_m[3];     /* its standard errors */
  double com_covariance[9];  /* (3, 3), [m^2] */
  double seconds;            /* of motion */
  double misfit;             /* squared standard errors a row that the load leaves: 1 where nothing else is */
  int32_t unseen_count;      /* directions of the centre of mass that the motion did not determine, unit vectors: */
  int32_t at_bound;          /* 1: the centre of mass is at the reach */
  double unseen[9];          /* (unseen_count, 3) */
} tauext_load_found;

#define TAUEXT_USUAL_REACH_M 0.3

/* Axes that force and moment are given along; the moment is about the frame's origin either way. */
typedef enum tauext_axes { TAUEXT_BASE_AXES = 0, TAUEXT_FRAME_AXES = 1 } tauext_axes;

/* Force and moment that the surroundings exert on the arm, and how sure that is; wrench.hpp has the equations. */
typedef struct tauext_wrench {
  size_t size;            /* set by the caller: sizeof(tauext_wrench); no more is written */
  int32_t known;          /* 0: the last sample had no torques with a standard error; all else is NaN then */
  int32_t unknowns;       /* 6: force, then moment; 3: force alone */
  double force[3];        /* [N] */
  double moment[3];       /* about the frame's origin, [N m]; of a force alone: what it makes at its point */
  double covariance[36];  /* its first (unknowns, unknowns), row-major */
  int32_t blind_count;    /* directions that this pose cannot show: their variance counts as infinite */
  int32_t freedom;        /* degrees of freedom of chi_square; 0: some wrench here explains whatever the joints show */
  double blind[36];       /* (blind_count, 6), unit vectors of N and of N m / 0.1 m */
  double chi_square;      /* of what such a wrench leaves unexplained */
  double consistent;      /* probability of so much or more where it is a touch at this frame */
} tauext_wrench;

typedef struct tauext_monitor tauext_monitor; /* made by tauext_monitor_open, freed by tauext_monitor_close */

/* The core is compiled with hidden symbols; these are what a shared library around it shows. */
#if defined(__GNUC__)
#pragma GCC visibility push(default)
#endif

/* Of the library, as "0.1.0". */
const char* tauext_version(void);
/* In words, as "warming up"; "" where there is no such value. */
const char* tauext_status_name(tauext_status status);
const char* tauext_health_name(int32_t health);
const char* tauext_alarm_name(int32_t alarm);
const char* tauext_touch_name(int32_t touch);
/* Of a single bit. */
const char* tauext_cause_name(uint32_t cause);

/* Reads the bundle, checks it and makes a monitor. On any status but TAUEXT_OK *monitor is NULL and message, unless NULL,
 * holds the reason, cut to message_size. */
tauext_status tauext_monitor_open(const char* bundle_path, tauext_network_rate rate, tauext_monitor** monitor,
                                  char* message, size_t message_size);
/* The same for a bundle in memory, which is not needed afterwards. */
tauext_status tauext_monitor_open_bytes(const void* bundle, size_t bundle_size, tauext_network_rate rate,
                                        tauext_monitor** monitor, char* message, size_t message_size);
/* Frees it; NULL is allowed. */
void tauext_monitor_close(tauext_monitor* monitor);

/* How many joints a sample has; 0 of NULL. */
int32_t tauext_monitor_joints(const tauext_monitor* monitor);
/* In the order of q, dq and tau. NULL: no such joint. Texts live as long as the monitor. */
const char* tauext_monitor_joint_name(const tauext_monitor* monitor, int32_t joint);
/* Unit of the tau that is to be given of a joint, and of the torques in the answers: "N m", "N", "A", "recorded unit",
 * "units of JOINT", "W". NULL: no such joint. Query them once: a bundle that was trained on currents takes amperes. */
const char* tauext_monitor_torque_unit(const tauext_monitor* monitor, int32_t joint);
const char* tauext_monitor_estimate_unit(const tauext_monitor* monitor, int32_t joint);
/* Of the bundle, [ns]; 0 of NULL. */
int64_t tauext_monitor_sample_period_ns(const tauext_monitor* monitor);

/* One sample: t_ns [ns] of a monotonic clock, q [rad], dq [rad/s], tau in the unit that
 * tauext_monitor_torque_unit names, one value a joint. estimate may be NULL. A bad signal is no error of the call: it is
 * answered in estimate->health. */
tauext_status tauext_monitor_step(tauext_monitor* monitor, int64_t t_ns, const double* q, const double* dq,
                                  const double* tau, tauext_estimate* estimate);
/* step in two: the answer, and what can wait until the command has been sent. */
tauext_status tauext_monitor_estimate(tauext_monitor* monitor, int64_t t_ns, const double* q, const double* dq,
                                      const double* tau, tauext_estimate* estimate);
tauext_status tauext_monitor_advance(tauext_monitor* monitor);
/* The loop ran and no sample came: stale for as long as missing samples are bridged (a network period, or three samples below 300 Hz),
 * then a fault. */
tauext_status tauext_monitor_no_sample(tauext_monitor* monitor, int64_t now_ns, tauext_estimate* estimate);
/* Ends a latched alarm, and nothing else; one whose cause lasts comes back. */
tauext_status tauext_monitor_acknowledge(tauext_monitor* monitor);
/* The same where nothing touches the arm any more and it is to move on: the static friction of joints near stiction is
 * unknown again, and with a prior raises their limits until they have slid. */
tauext_status tauext_monitor_resume(tauext_monitor* monitor);
/* Limits are the bundle's times these, a joint: 0.1 to 10, 1 leaves them as they are; else TAUEXT_BAD_ARGUMENT, and
 * nothing is changed. */
tauext_status tauext_monitor_set_limit_factors(tauext_monitor* monitor, const double* collision, const double* contact);
/* Temperatures of the joints, [degC], NaN where one is not known, from the next sample on; what was known before holds. Call
 * it as often as there are new ones: friction follows them where training found that it does. */
tauext_status tauext_monitor_set_temperature(tauext_monitor* monitor, const double* celsius);
/* What the arm carries from the next sample on or, since_ns being a time of the samples, as if it had been set then
 * (see monitor.hpp). Else TAUEXT_BAD_LOAD, and nothing is changed. */
tauext_status tauext_monitor_set_load(tauext_monitor* monitor, const tauext_load* load, int64_t since_ns);
/* It carries nothing more. */
tauext_status tauext_monitor_clear_load(tauext_monitor* monitor, int64_t since_ns);
/* The gripper closes or opens: for so many seconds (60 at most) what the arm carries may become anything up to at_most_kg
 * in all. What fits that is weighed, set and reported (load_phase, load_found_ns); what does not is the usual alarm, at most
 * about half a second late. TAUEXT_BAD_LOAD where tauext_monitor_why_not_expected writes a reason. */
tauext_status tauext_monitor_expect_load(tauext_monitor* monitor, double seconds, double at_most_kg);
/* Writes why, cut to message_size; "" where it would be. Not for the loop. */
tauext_status tauext_monitor_why_not_expected(const tauext_monitor* monitor, double seconds, double at_most_kg,
                                              char* message, size_t message_size);
/* The load that holds now. */
tauext_status tauext_monitor_load(const tauext_monitor* monitor, tauext_load* load);
/* Writes why such a load would be refused, cut to message_size; "" where it would be taken. Not for the loop. */
tauext_status tauext_monitor_why_no_load(const tauext_monitor* monitor, const tauext_load* load, int64_t since_ns,
                                         char* message, size_t message_size);
const char* tauext_monitor_load_frame(const tauext_monitor* monitor); /* "" where no load can be set */
/* What is it carrying? Weighs it beside the load that is set, from the next sample on (see monitor.hpp); the centre of
 * mass is within reach_m > 0 of the load frame, TAUEXT_USUAL_REACH_M where no better bound is known. TAUEXT_BAD_LOAD: this
 * bundle cannot; TAUEXT_BAD_ARGUMENT: no such reach; nothing is changed then. What was found stays after stop. */
tauext_status tauext_monitor_start_weighing(tauext_monitor* monitor, double reach_m);
tauext_status tauext_monitor_stop_weighing(tauext_monitor* monitor);
int32_t tauext_monitor_weighing(const tauext_monitor* monitor); /* 1 while it runs */
/* Takes as long as some fifty samples; allocates nothing. */
tauext_status tauext_monitor_estimate_load(const tauext_monitor* monitor, tauext_load_found* found);
/* Number of a frame: a joint's link, the load's frame or one of the robot file's; -1: there is none of that name. */
int32_t tauext_monitor_find_frame(const tauext_monitor* monitor, const char* name);
/* "" or why this bundle has no wrench; it stands as long as the monitor. */
const char* tauext_monitor_why_no_wrench(const tauext_monitor* monitor);
/* At the last sample, of a frame by its number; microseconds, and nothing is allocated or changed. TAUEXT_BAD_ARGUMENT: no
 * such frame or axes. `force` is of a force alone that acts at point, 3 numbers along the frame's own axes, [m]. */
tauext_status tauext_monitor_wrench(const tauext_monitor* monitor, int32_t frame, tauext_axes axes, tauext_wrench* wrench);
tauext_status tauext_monitor_force(const tauext_monitor* monitor, int32_t frame, const double* point, tauext_axes axes,
                                   tauext_wrench* wrench);
/* As newly made. */
tauext_status tauext_monitor_reset(tauext_monitor* monitor);

/* A refit's morning routine. reserve allocates, outside the loop: memory for so many seconds, above 0 and at most 600.
 * From start on motion is kept and limits are higher by a share of the joint's friction, 0 to 2 (0.4 is usual), until
 * finish; TAUEXT_BAD_ARGUMENT without memory, or where the bundle's prior has no friction. full: 1 once as much is kept. start,
 * full and finish do not allocate, lock, log or call the system. */
tauext_status tauext_monitor_reserve_refit(tauext_monitor* monitor, double seconds);
tauext_status tauext_monitor_start_refit(tauext_monitor* monitor, double friction_share);
int32_t tauext_monitor_refit_full(const tauext_monitor* monitor);
tauext_status tauext_monitor_finish_refit(tauext_monitor* monitor);
/* After finish, and in any thread while the loop continues: the bundle whose friction is that of the motion kept. Takes
 * seconds. On any status but TAUEXT_OK nothing is written, and message, unless NULL, holds the reason. */
tauext_status tauext_refit(const char* bundle_path, const tauext_monitor* monitor, const char* out_path, char* message,
                           size_t message_size);

/* The whole state, of so many bytes, to go on in another monitor of the same bundle, rate, build and kind of processor.
 * A wrong size to save is TAUEXT_BAD_ARGUMENT; TAUEXT_BAD_STATE: nothing was restored. */
size_t tauext_monitor_state_bytes(const tauext_monitor* monitor);
tauext_status tauext_monitor_save_state(const tauext_monitor* monitor, void* state, size_t size);
tauext_status tauext_monitor_restore_state(tauext_monitor* monitor, const void* state, size_t size);

#if defined(__GNUC__)
#pragma GCC visibility pop
#endif

#ifdef __cplusplus
}
#endif
#endif
