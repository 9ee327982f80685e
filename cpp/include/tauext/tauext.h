/* The monitor for C and for languages that call C: an opaque handle, status codes, no exceptions.
 *
 *   tauext_monitor* monitor;
 *   char message[256];
 *   if (tauext_monitor_open("arm.tauext", TAUEXT_EVERY_SAMPLE, &monitor, message, sizeof message) != TAUEXT_OK) ...
 *   tauext_estimate e = {.size = sizeof e};
 *   tauext_monitor_step(monitor, t_ns, q, dq, tau, &e);      once per sample period
 *
 * Torques are positive if they push the joint in its positive direction; tau is the motor's torque at the joint's side
 * of the gear. A null pointer returns TAUEXT_BAD_ARGUMENT, unless documented as allowed.
 * tauext_monitor_estimate, _advance, _step, _no_sample, _acknowledge, _resume, _set_limit_factors, _set_load,
 * _clear_load, _expect_load, _expect_contact, _end_contact, _tool_force, _reset, _save_state and _restore_state do not
 * allocate, lock, log or call the system. Use each monitor from one thread at a time. */
#ifndef TAUEXT_H
#define TAUEXT_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define TAUEXT_MAX_JOINTS 32  /* largest number of joints, and length of the arrays of an estimate */

/* Result of a call. */
typedef enum tauext_status {
  TAUEXT_OK = 0,
  TAUEXT_BAD_ARGUMENT = 1,  /* a null pointer, or a size that does not fit */
  TAUEXT_BAD_BUNDLE = 2,   /* the message contains the reason */
  TAUEXT_NO_MEMORY = 3,    /* the monitor could not be allocated */
  TAUEXT_BAD_STATE = 4,    /* damaged, or of another monitor */
  TAUEXT_BAD_LOAD = 5,     /* tauext_monitor_why_no_load returns the reason */
  TAUEXT_BAD_CONTACT = 6   /* tauext_monitor_why_no_contact returns the reason */
} tauext_status;

/* How often the network is evaluated: at every sample, or, for slow processors, once per network period (about 10
 * ms). */
typedef enum tauext_network_rate {
  TAUEXT_EVERY_SAMPLE = 0,
  TAUEXT_NETWORK_PERIOD = 1,
  TAUEXT_NETWORK_RATE_RANGE = 0x7fffffff /* no rate: every int has a defined value, so that a wrong one is refused */
} tauext_network_rate;

/* Whether the torques of an estimate can be trusted. */
typedef enum tauext_health {
  TAUEXT_WARMING_UP = 0,  /* no estimate yet */
  TAUEXT_HEALTHY = 1,    /* the torques are valid */
  TAUEXT_STALE = 2,      /* the last estimate is held */
  TAUEXT_FAULT = 3       /* the signals are impossible or unusable */
} tauext_health;

/* A contact ends by itself; a collision stays until it is acknowledged. */
typedef enum tauext_alarm { TAUEXT_NO_ALARM = 0, TAUEXT_CONTACT = 1, TAUEXT_COLLISION = 2 } tauext_alarm;

/* Bits of tauext_estimate.causes: causes of a health that is not healthy, or of the current warm-up. */
typedef enum tauext_cause {
  TAUEXT_NOT_FINITE = 1,             /* NaN or infinity in q, dq or tau, or values that are too large */
  TAUEXT_WRONG_SIZE = 2,             /* not one value per joint; impossible from C */
  TAUEXT_LATE_SAMPLE = 4,            /* older than the newest sample, by at most a network period: skipped */
  TAUEXT_TIME_BACKWARDS = 8,         /* older by more: the clock was set back */
  TAUEXT_MISSING_SAMPLE = 16,        /* no sample, for at most a network period */
  TAUEXT_GAP = 32,                   /* no sample for longer */
  TAUEXT_WRONG_RATE = 64,            /* the mean step of the samples differs from the bundle's period */
  TAUEXT_TORQUE_SATURATED = 128,     /* a drive at its limit gives another torque than commanded */
  TAUEXT_ENCODER_STILL = 256,        /* a position does not change while velocity or torque indicate motion */
  TAUEXT_IMPOSSIBLE_TORQUE = 512,    /* more than the drive can give */
  TAUEXT_IMPOSSIBLE_VELOCITY = 1024,  /* faster than the joint can move */
  TAUEXT_IMPOSSIBLE_POSITION = 2048  /* farther from the last position than the joint can move */
} tauext_cause;

/* Progress of an expected payload. */
typedef enum tauext_load_phase {
  TAUEXT_NO_LOAD_EXPECTED = 0,
  TAUEXT_EXPECTING_LOAD = 1,  /* no payload detected yet */
  TAUEXT_DECIDING_LOAD = 2,  /* an alarm is held back: the torque fits a payload */
  TAUEXT_LOAD_FOUND = 3,     /* a payload was set; more mass is added until the window ends */
  TAUEXT_WEIGHING_LOAD = 4   /* the window is over and no alarm is held back; the identification continues */
} tauext_load_phase;

/* Kind of touch behind an alarm. */
typedef enum tauext_touch {
  TAUEXT_NO_TOUCH = 0,      /* no alarm */
  TAUEXT_UNKNOWN_TOUCH = 1, /* not decided yet, or none of the others */
  TAUEXT_IMPACT = 2,        /* the torque came and went within a bounce */
  TAUEXT_PUSH = 3,          /* the contact yields */
  TAUEXT_CLAMP = 4,         /* it does not: the torque grows as the arm moves on, or keeps growing at rest */
  TAUEXT_LOAD_TOUCH = 5     /* a weight at the load frame */
} tauext_touch;

/* What an expected contact explains of a sample. */
typedef enum tauext_declared {
  TAUEXT_NOTHING_DECLARED = 0, /* no expected contact is in effect, or there is no torque */
  TAUEXT_WITHIN = 1,           /* in effect; what its bounds admit is explained */
  TAUEXT_BEYOND = 2,           /* the force or torque is larger than declared by more than two standard errors */
  TAUEXT_MOVED = 3             /* the point moved farther along the axis than declared: nothing is explained */
} tauext_declared;

/* Result for one sample. Torques that do not exist are NaN. Only (health == TAUEXT_HEALTHY && alarm ==
 * TAUEXT_NO_ALARM) means "no collision". */
typedef struct tauext_estimate {
  size_t size; /* set by the caller: sizeof(tauext_estimate), at least up to `residual`; no more is written */
  int64_t t_ns;           /* time stamp of the sample, [ns] */
  int32_t joints;         /* number of joints; further array elements are meaningless */
  int32_t health;         /* tauext_health */
  uint32_t causes;        /* bits of tauext_cause */
  int32_t cause_joint;    /* first joint that a cause concerns; -1: none */
  int32_t alarm;          /* tauext_alarm, latched */
  int32_t alarm_joint;    /* joint that raised the alarm to its level; -1: none */
  int64_t alarm_t_ns;     /* time at which the alarm rose to its level, [ns] */
  int32_t detection;      /* 1: some |tau_ext| exceeds its collision threshold at this sample */
  uint32_t near_stiction;  /* a bit per joint: its threshold near stiction applies */
  double residual[TAUEXT_MAX_JOINTS];    /* [N m], r of the observer */
  double uncertainty[TAUEXT_MAX_JOINTS]; /* [N m], r expected in free motion: prior, network and drift */
  double tau_ext[TAUEXT_MAX_JOINTS];     /* [N m], residual - uncertainty */
  double limit_nm[TAUEXT_MAX_JOINTS];    /* [N m], collision threshold of |tau_ext|; infinite: not monitored */
  double margin_nm[TAUEXT_MAX_JOINTS];   /* [N m], limit_nm - |tau_ext - load_nm - declared_nm| */
  double drift[TAUEXT_MAX_JOINTS];       /* [N m], slow changes since training; part of uncertainty */
  uint32_t drift_saturated; /* a bit per joint: drift has reached its bound, retrain; health is unchanged */
  uint32_t unused;                       /* 0 */
  double sigma_nm[TAUEXT_MAX_JOINTS];    /* [N m], standard error of tau_ext in free motion; NaN: unknown */
  double unfamiliar; /* distance of the motion from the training motion, 0 to 1; report from 0.5 on */
  double load_kg;                        /* mass that the model carries; 0: none */
  int32_t load_phase;                    /* tauext_load_phase */
  int32_t touch;                         /* tauext_touch: kind of touch behind the alarm */
  int64_t load_found_ns;                 /* sample at which the last expected payload was found; 0: none */
  double load_error_kg;                  /* standard error of its mass, with that of the torque constants */
  double load_nm[TAUEXT_MAX_JOINTS];     /* [N m], part of tau_ext attributed to an expected payload */
  double contact_sigma_nm[TAUEXT_MAX_JOINTS];  /* [N m], standard error during and after a contact */
  uint32_t alarm_number;                 /* of the newest alarm, which stands if one does; 0: there was none */
  int32_t touch_over;                    /* 1: no alarm, or within all thresholds, and known, for the release time of a contact */
  int64_t touch_t_ns;                    /* last sample at which some joint was over a threshold; 0: none since the last alarm */
  int32_t declared;                      /* tauext_declared: of the expected contact in effect */
  int32_t declared_contact;              /* its number, of tauext_monitor_expect_contact; -1: none */
  double declared_size;                  /* its force within the cone, however large, [N]; of a joint the torque */
  double declared_sigma;                 /* standard error of that */
  double declared_moment_nm;             /* its moment, [N m] */
  double declared_travel_m;              /* way of its point along the axis since the contact began, [m] */
  double declared_nm[TAUEXT_MAX_JOINTS]; /* [N m], part of tau_ext that expected contacts explain */
} tauext_estimate;

/* What the arm carries in addition to its own links, in the axes of tauext_monitor_load_frame(). */
typedef struct tauext_load {
  double mass;        /* [kg]; 0: nothing */
  double com[3];      /* centre of mass in the load frame, [m] */
  double inertia[6];  /* about the centre of mass: xx, yy, zz, xy, xz, yz, [kg m^2]; zeros: a point */
  double error_share;  /* thresholds rise by this share of its torques; TAUEXT_USUAL_LOAD_ERROR; 0: exact */
} tauext_load;

#define TAUEXT_USUAL_LOAD_ERROR 0.03
#define TAUEXT_FROM_NOW INT64_MAX  /* value of since_ns: from the next sample on */

/* Result of a payload identification. */
typedef enum tauext_load_verdict {
  TAUEXT_TOO_LITTLE_MOTION = 0,  /* less than 0.3 s */
  TAUEXT_NO_LOAD_SHOWS = 1,
  TAUEXT_LOAD_SHOWS = 2,
  TAUEXT_CONTACT_FITS_BETTER = 3,  /* a constant force fits better: something touches the arm */
  TAUEXT_PULLS_UP = 4,
  TAUEXT_LOAD_UNCLEAR = 5         /* no hypothesis explains the torques */
} tauext_load_verdict;

/* All members but `load` describe what the arm carries beside the payload that is set; lengths and axes are those of
 * the load frame. */
typedef struct tauext_load_found {
  size_t size;               /* set by the caller: sizeof(tauext_load_found); no more is written */
  int32_t verdict;           /* tauext_load_verdict */
  int32_t mass_seen;         /* 0: the motion does not separate the mass from its lever */
  tauext_load load;          /* both payloads together, for tauext_monitor_set_load */
  double mass_kg;            /* negative if the arm carries less than the payload that is set */
  double mass_error_kg;      /* standard error from the errors of tau_ext in this motion */
  double com_m[3];           /* centre of mass, [m] */
  double com_error_m[3];     /* its standard errors, with those of the torque constants, [m] */
  double com_covariance[9];  /* (3, 3), without the torque constants, [m^2] */
  double seconds;            /* duration of the motion, [s] */
  double misfit;             /* squared standard errors per row that the payload leaves: 1 if nothing else acts */
  int32_t unseen_count;      /* number of directions of the centre of mass that the motion does not determine */
  int32_t at_bound;          /* 1: the centre of mass is at reach_m */
  double unseen[9];          /* (unseen_count, 3), unit vectors */
  double constants_error_kg; /* standard error from the torque constants, about the same share of every weight */
} tauext_load_found;

#define TAUEXT_USUAL_REACH_M 0.3

/* Axes of force and moment. The moment is about the frame's origin in both cases. */
typedef enum tauext_axes {
  TAUEXT_BASE_AXES = 0,
  TAUEXT_FRAME_AXES = 1,
  TAUEXT_AXES_RANGE = 0x7fffffff /* no axes: as TAUEXT_NETWORK_RATE_RANGE */
} tauext_axes;

/* Force and moment that the environment exerts on the arm, with covariance; equations in wrench.hpp. */
typedef struct tauext_wrench {
  size_t size;            /* set by the caller: sizeof(tauext_wrench); no more is written */
  int32_t known;          /* 0: no torques with a standard error at the last sample; other members are NaN */
  int32_t unknowns;       /* 6: force, then moment; 3: force only */
  double force[3];        /* [N] */
  double moment[3];       /* about the frame's origin, [N m]; with 3 unknowns the moment of the force */
  double covariance[36];  /* (unknowns, unknowns), row-major */
  int32_t blind_count;    /* directions that this pose cannot show: their variance counts as infinite */
  int32_t freedom;        /* degrees of freedom of chi_square; 0: some wrench here explains any torques */
  double blind[36];       /* (blind_count, 6), unit vectors of N and of N m / 0.1 m */
  double chi_square;      /* of the torques that the wrench does not explain */
  double consistent;      /* p-value of chi_square for a touch at this frame; 1 if freedom is 0 */
} tauext_wrench;

/* What the task means the environment to exert, see declared_contact.hpp: at a frame a force within a cone and a moment,
 * or a torque of one joint. Start from TAUEXT_CONTACT_AT(frame) or TAUEXT_CONTACT_OF(joint). */
typedef struct tauext_contact_bounds {
  size_t size;            /* set by the caller: sizeof(tauext_contact_bounds) */
  int32_t frame;          /* of tauext_monitor_find_frame; -1: of a joint */
  int32_t joint;          /* -1: at a frame */
  double point[3];        /* where the force acts, [m] along the frame's own axes */
  double axis[3];         /* direction of the force on the arm, of any length; zeros: any direction */
  int32_t axes;           /* tauext_axes of the axis */
  int32_t boxed;          /* 1: in effect only while the frame's origin is in the box */
  double half_angle_rad;  /* of the cone around the axis, 0 (a line) to pi/2 */
  double at_most_n;       /* largest force */
  double at_most_nm;      /* largest moment; of a joint its torque, in the joint's unit */
  double at_most_travel_m; /* largest way of the point along the axis during the contact; infinite: any */
  double lowest_m[3], highest_m[3]; /* corners of the box, in the base's axes */
} tauext_contact_bounds;

#define TAUEXT_CONTACT_AT(frame) \
  { sizeof(tauext_contact_bounds), (frame), -1, {0, 0, 0}, {0, 0, 0}, TAUEXT_FRAME_AXES, 0, 0, 0, 0, HUGE_VAL, {0, 0, 0}, {0, 0, 0} }
#define TAUEXT_CONTACT_OF(joint) \
  { sizeof(tauext_contact_bounds), -1, (joint), {0, 0, 0}, {0, 0, 0}, TAUEXT_FRAME_AXES, 0, 0, 0, 0, HUGE_VAL, {0, 0, 0}, {0, 0, 0} }

/* The force at the tool as a sensor would measure it. */
typedef struct tauext_tool_force {
  size_t size;           /* set by the caller: sizeof(tauext_tool_force); no more is written */
  int32_t frame;         /* where it acts; -1: there is no tool's frame */
  int32_t declared;      /* 1: at the expected contact in effect; 0: at the load frame */
  double motion_n;       /* standard errors of the force along itself: errors of free motion, */
  double rest_n;         /* friction that resting joints hide, and lag, */
  double constants_n;    /* torque constants and gear friction under the load */
  tauext_wrench wrench;  /* its size is set by the call */
} tauext_tool_force;

typedef struct tauext_monitor tauext_monitor; /* made by tauext_monitor_open, freed by tauext_monitor_close */

/* The core is compiled with hidden symbols; a shared library around it exports these. */
#if defined(__GNUC__)
#pragma GCC visibility push(default)
#endif

/* Version of the library, as "0.1.0". */
const char* tauext_version(void);
/* Names such as "warming up"; "" for an unknown value. */
const char* tauext_status_name(tauext_status status);
const char* tauext_health_name(int32_t health);
const char* tauext_alarm_name(int32_t alarm);
const char* tauext_touch_name(int32_t touch);
/* Name of a single bit. */
const char* tauext_cause_name(uint32_t cause);

/* Reads and checks a bundle and creates a monitor. On any status but TAUEXT_OK, *monitor is NULL and message,
 * unless NULL, contains the reason, cut to message_size. */
tauext_status tauext_monitor_open(const char* bundle_path, tauext_network_rate rate, tauext_monitor** monitor,
                                  char* message, size_t message_size);
/* The same for a bundle in memory, which may be freed afterwards. */
tauext_status tauext_monitor_open_bytes(const void* bundle, size_t bundle_size, tauext_network_rate rate,
                                        tauext_monitor** monitor, char* message, size_t message_size);
/* Frees a monitor; NULL is allowed. */
void tauext_monitor_close(tauext_monitor* monitor);

/* Number of joints; 0 for NULL. */
int32_t tauext_monitor_joints(const tauext_monitor* monitor);
/* Joint name, in the order of q, dq and tau; NULL: no such joint. Strings live as long as the monitor. */
const char* tauext_monitor_joint_name(const tauext_monitor* monitor, int32_t joint);
/* Units of the input tau and of the estimated torques of a joint: "N m", "N", "A", "recorded unit", "units of
 * JOINT", "W". NULL: no such joint. Check them once: a bundle that was trained on currents takes amperes. */
const char* tauext_monitor_torque_unit(const tauext_monitor* monitor, int32_t joint);
const char* tauext_monitor_estimate_unit(const tauext_monitor* monitor, int32_t joint);
/* Sample period of the bundle, [ns]; 0 for NULL. */
int64_t tauext_monitor_sample_period_ns(const tauext_monitor* monitor);

/* Processes one sample: t_ns [ns] of a monotonic clock, q [rad], dq [rad/s], tau in tauext_monitor_torque_unit, one
 * value per joint. estimate may be NULL. A faulty signal is not an error of the call; it is reported in
 * estimate->health. */
tauext_status tauext_monitor_step(tauext_monitor* monitor, int64_t t_ns, const double* q, const double* dq,
                                  const double* tau, tauext_estimate* estimate);
/* The two parts of step: the estimate, and the work that can wait until the command is out. */
tauext_status tauext_monitor_estimate(tauext_monitor* monitor, int64_t t_ns, const double* q, const double* dq,
                                      const double* tau, tauext_estimate* estimate);
tauext_status tauext_monitor_advance(tauext_monitor* monitor);
/* Reports that the loop ran without a sample. Health is stale for up to a network period (below 300 Hz: three
 * samples), then a fault. */
tauext_status tauext_monitor_no_sample(tauext_monitor* monitor, int64_t now_ns, tauext_estimate* estimate);
/* Ends a latched alarm and does nothing else. If the cause persists, the alarm rises again. */
tauext_status tauext_monitor_acknowledge(tauext_monitor* monitor);
/* Ends a latched alarm of an arm that nothing touches any more and that is about to move on. The static friction of
 * joints near stiction becomes unknown; with a prior, their thresholds are higher until they have slid. */
tauext_status tauext_monitor_resume(tauext_monitor* monitor);
/* Multiplies the bundle's thresholds by one factor per joint, 0.1 to 10. Returns TAUEXT_BAD_ARGUMENT and changes
 * nothing for other values. */
tauext_status tauext_monitor_set_limit_factors(tauext_monitor* monitor, const double* collision, const double* contact);
/* Sets the joint temperatures [degC] from the next sample on; NaN: unknown, the last known value remains in effect.
 * Call it for each new value. Used if training found that friction follows them. */
tauext_status tauext_monitor_set_temperature(tauext_monitor* monitor, const double* celsius);
/* Sets what the arm carries from the next sample on, or as if it had been set at since_ns, in sample time (see
 * monitor.hpp). Returns TAUEXT_BAD_LOAD and changes nothing if the payload is refused. */
tauext_status tauext_monitor_set_load(tauext_monitor* monitor, const tauext_load* load, int64_t since_ns);
/* Removes the payload. */
tauext_status tauext_monitor_clear_load(tauext_monitor* monitor, int64_t since_ns);
/* Announces that the gripper closes or opens: for `seconds` (at most 60), the arm may come to carry up to
 * at_most_kg in all. A step that fits is identified, set and reported (load_phase, load_found_ns). Any other step
 * raises the usual alarm, late if it first resembled a payload. Returns TAUEXT_BAD_LOAD if
 * tauext_monitor_why_not_expected gives a reason. */
tauext_status tauext_monitor_expect_load(tauext_monitor* monitor, double seconds, double at_most_kg);
/* Writes the reason for a refusal, cut to message_size; "": none. Allocates: not for the loop. */
tauext_status tauext_monitor_why_not_expected(const tauext_monitor* monitor, double seconds, double at_most_kg,
                                              char* message, size_t message_size);
/* Declares a contact for `seconds` from the next sample on (HUGE_VAL: until tauext_monitor_end_contact); the alarm uses
 * only what it cannot explain (see monitor.hpp). Writes its number. Returns TAUEXT_BAD_CONTACT and changes nothing if
 * tauext_monitor_why_no_contact gives a reason. */
tauext_status tauext_monitor_expect_contact(tauext_monitor* monitor, const tauext_contact_bounds* contact, double seconds,
                                            int32_t* which);
/* Ends an expected contact at once; TAUEXT_BAD_CONTACT: there is none of this number. */
tauext_status tauext_monitor_end_contact(tauext_monitor* monitor, int32_t which);
/* Write, cut to message_size, the reason for a refusal, or what is not monitored while the contact is in effect; "":
 * none, nothing. Allocate: not for the loop. */
tauext_status tauext_monitor_why_no_contact(const tauext_monitor* monitor, const tauext_contact_bounds* contact,
                                            double seconds, char* message, size_t message_size);
tauext_status tauext_monitor_unmonitored(const tauext_monitor* monitor, const tauext_contact_bounds* contact, char* message,
                                         size_t message_size);
/* The force on the tool at the last sample: at the expected contact in effect, else at the load frame. */
tauext_status tauext_monitor_tool_force(const tauext_monitor* monitor, tauext_axes axes, tauext_tool_force* tool);
/* Reads the payload in effect. */
tauext_status tauext_monitor_load(const tauext_monitor* monitor, tauext_load* load);
/* Writes the reason for which this payload would be refused, cut to message_size; "": accepted. Allocates: not for the
 * loop. */
tauext_status tauext_monitor_why_no_load(const tauext_monitor* monitor, const tauext_load* load, int64_t since_ns,
                                         char* message, size_t message_size);
const char* tauext_monitor_load_frame(const tauext_monitor* monitor);  /* "": no payload can be set */
/* Starts to identify what the arm carries beside the payload that is set, from the next sample on (see monitor.hpp). The
 * centre of mass is within reach_m > 0 of the load frame; the default is TAUEXT_USUAL_REACH_M. Changes nothing and
 * returns TAUEXT_BAD_LOAD if the bundle cannot weigh, TAUEXT_BAD_ARGUMENT for another reach. The result remains
 * after stop. */
tauext_status tauext_monitor_start_weighing(tauext_monitor* monitor, double reach_m);
tauext_status tauext_monitor_stop_weighing(tauext_monitor* monitor);
int32_t tauext_monitor_weighing(const tauext_monitor* monitor); /* 1 while it runs */
/* Reads the result so far. Takes as long as about fifty samples; allocates nothing. */
tauext_status tauext_monitor_estimate_load(const tauext_monitor* monitor, tauext_load_found* found);
/* Number of a frame by its name: a joint's link, the load frame or a frame of the robot file; -1: unknown. */
int32_t tauext_monitor_find_frame(const tauext_monitor* monitor, const char* name);
/* Reason for which the bundle has no wrench; "": none. The string lives as long as the monitor. */
const char* tauext_monitor_why_no_wrench(const tauext_monitor* monitor);
/* Estimate the wrench at a frame for the last sample, or only a force that acts at `point`, 3 coordinates along the
 * frame's own axes, [m]. Microseconds; allocate and change nothing. TAUEXT_BAD_ARGUMENT: unknown frame or axes. */
tauext_status tauext_monitor_wrench(const tauext_monitor* monitor, int32_t frame, tauext_axes axes, tauext_wrench* wrench);
tauext_status tauext_monitor_force(const tauext_monitor* monitor, int32_t frame, const double* point, tauext_axes axes,
                                   tauext_wrench* wrench);
/* How often the stamps jumped: they went back, stood still for 100 samples, or a gap exceeded 10 s. Everything with a time ended
 * then: expected contacts with a time, an expected payload (an alarm that was held back is raised), an identification, motion for a refit. Ask
 * for it again. 0 for a null pointer. */
uint64_t tauext_monitor_clock_jumps(const tauext_monitor* monitor);
/* Returns to the state of a new monitor. */
tauext_status tauext_monitor_reset(tauext_monitor* monitor);

/* Motion for a refit. reserve allocates memory for `seconds` of samples, above 0 and at most 600; call it before
 * the loop. From start to finish, motion is stored and thresholds are higher by friction_share of the joint's friction,
 * 0 to 2 (default 0.4). start returns TAUEXT_BAD_ARGUMENT without memory, or without friction in the prior. full: 1
 * if the memory is full. start, full and finish do not allocate, lock, log or call the system. */
tauext_status tauext_monitor_reserve_refit(tauext_monitor* monitor, double seconds);
tauext_status tauext_monitor_start_refit(tauext_monitor* monitor, double friction_share);
int32_t tauext_monitor_refit_full(const tauext_monitor* monitor);
tauext_status tauext_monitor_finish_refit(tauext_monitor* monitor);
/* Writes a bundle with the friction of the stored motion. Call it after finish, in any thread while the loop
 * continues; it takes seconds. On any status but TAUEXT_OK no file is written, and message, unless NULL, contains
 * the reason. */
tauext_status tauext_refit(const char* bundle_path, const tauext_monitor* monitor, const char* out_path, char* message,
                           size_t message_size);

/* The whole state, for another monitor of the same bundle, network rate, build and type of processor. A wrong size
 * in save_state is TAUEXT_BAD_ARGUMENT; TAUEXT_BAD_STATE: nothing was restored. */
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
