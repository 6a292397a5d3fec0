/* FMI 3.0 of the FMU. Compile this file alone to a shared library. With -DFMI_HEADERS, it uses the standard's headers. */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

#include "fmu.c"

#ifdef FMI_HEADERS
#include "fmi3Functions.h"
#else
#ifdef __GNUC__
#define FMI3_Export __attribute__((visibility("default")))
#elif defined _WIN32
#define FMI3_Export __declspec(dllexport)
#else
#define FMI3_Export
#endif
typedef void *fmi3Instance, *fmi3InstanceEnvironment, *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef float fmi3Float32;
typedef double fmi3Float64;
typedef int8_t fmi3Int8;
typedef uint8_t fmi3UInt8, fmi3Byte;
typedef int16_t fmi3Int16;
typedef uint16_t fmi3UInt16;
typedef int32_t fmi3Int32;
typedef uint32_t fmi3UInt32;
typedef int64_t fmi3Int64;
typedef uint64_t fmi3UInt64;
typedef bool fmi3Boolean, fmi3Clock;
typedef const char *fmi3String;
typedef const fmi3Byte *fmi3Binary;
typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef enum {
  fmi3Independent, fmi3Constant, fmi3Fixed, fmi3Tunable, fmi3Discrete, fmi3Dependent
} fmi3DependencyKind;
typedef enum { fmi3IntervalNotYetKnown, fmi3IntervalUnchanged, fmi3IntervalChanged } fmi3IntervalQualifier;
typedef void (*fmi3LogMessageCallback)(fmi3InstanceEnvironment, fmi3Status, fmi3String, fmi3String);
typedef void (*fmi3ClockUpdateCallback)(fmi3InstanceEnvironment);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment, fmi3Float64, fmi3Boolean, fmi3Boolean,
                                               fmi3Boolean, fmi3Boolean, fmi3Boolean *, fmi3Float64 *);
typedef void (*fmi3LockPreemptionCallback)(void);
typedef void (*fmi3UnlockPreemptionCallback)(void);
#endif

typedef struct {
  fmu state;
  fmi3LogMessageCallback log;
  fmi3InstanceEnvironment environment;
} instance;

typedef const fmi3ValueReference *references;

static fmi3Status report(const instance *c, fmi3Status status, const char *message) {
  if (c->log != NULL) c->log(c->environment, status, "logStatusError", message);
  return status;
}

/* The status of a function that returns NULL or the reason of its failure. */
static fmi3Status check(const instance *c, const char *reason) {
  return reason == NULL ? fmi3OK : report(c, fmi3Error, reason);
}

static fmi3Status result(const instance *c, mech_status status, fmi3Status failure) {
  return status == MECH_OK ? fmi3OK : report(c, failure, REASON[status]);
}

FMI3_Export const char *fmi3GetVersion(void) { return "3.0"; }

FMI3_Export fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String categories[]) {
  return (void)c, (void)on, (void)n, (void)categories, fmi3OK; /* errors are always reported */
}

static fmi3Instance instantiate(int is_model_exchange, fmi3String token, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
  instance *c = calloc(1, sizeof *c);
  if (c == NULL) return NULL;
  c->log = log;
  c->environment = environment;
  fmu_reset(&c->state, is_model_exchange);
  if (token != NULL && strcmp(token, IDENTITY) == 0) return c;
  report(c, fmi3Error, "the instantiation token is not that of the model description");
  free(c);
  return NULL;
}

FMI3_Export fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                                      fmi3Boolean visible, fmi3Boolean logs,
                                                      fmi3InstanceEnvironment environment,
                                                      fmi3LogMessageCallback log) {
  (void)name, (void)resources, (void)visible, (void)logs;
  return instantiate(1, token, environment, log);
}

FMI3_Export fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                                     fmi3Boolean visible, fmi3Boolean logs, fmi3Boolean has_events,
                                                     fmi3Boolean returns_early, const fmi3ValueReference required[],
                                                     size_t n, fmi3InstanceEnvironment environment,
                                                     fmi3LogMessageCallback log,
                                                     fmi3IntermediateUpdateCallback update) {
  (void)name, (void)resources, (void)visible, (void)logs, (void)has_events;
  (void)returns_early, (void)required, (void)n, (void)update;
  return instantiate(0, token, environment, log);
}

FMI3_Export fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                                           fmi3Boolean visible, fmi3Boolean logs,
                                                           fmi3InstanceEnvironment environment,
                                                           fmi3LogMessageCallback log, fmi3ClockUpdateCallback clock,
                                                           fmi3LockPreemptionCallback lock,
                                                           fmi3UnlockPreemptionCallback unlock) {
  (void)name, (void)token, (void)resources, (void)visible, (void)logs, (void)clock, (void)lock, (void)unlock;
  if (log != NULL) log(environment, fmi3Error, "logStatusError", "scheduled execution is not supported");
  return NULL;
}

FMI3_Export void fmi3FreeInstance(fmi3Instance c) { free(c); }

FMI3_Export fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance, fmi3Float64 tolerance,
                                                   fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop) {
  fmu *x = &((instance *)c)->state;
  (void)has_stop, (void)stop;
  if (has_tolerance && tolerance > 0.0) x->tolerance = tolerance;
  x->values[TIME] = start;
  return fmi3OK;
}

FMI3_Export fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
  fmu *x = &((instance *)c)->state;
  const mech_status status = fmu_assemble(x);
  x->is_initializing = 0;
  return result(c, status, fmi3Error);
}

FMI3_Export fmi3Status fmi3Reset(fmi3Instance c) {
  fmu *x = &((instance *)c)->state;
  fmu_reset(x, x->is_model_exchange);
  return fmi3OK;
}

/* Modes without anything to do. */
#define NOTHING_TO_DO(Function) \
  FMI3_Export fmi3Status Function(fmi3Instance c) { return (void)c, fmi3OK; }
NOTHING_TO_DO(fmi3EnterEventMode)
NOTHING_TO_DO(fmi3EnterContinuousTimeMode)
NOTHING_TO_DO(fmi3EnterStepMode)
NOTHING_TO_DO(fmi3EnterConfigurationMode)
NOTHING_TO_DO(fmi3ExitConfigurationMode)
NOTHING_TO_DO(fmi3EvaluateDiscreteStates)
NOTHING_TO_DO(fmi3Terminate)

FMI3_Export fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference r[], size_t n, fmi3Float64 values[],
                                      size_t size) {
  if (n != size) return report(c, fmi3Error, "all variables are scalars");
  return check(c, fmu_get(&((instance *)c)->state, r, n, values));
}

FMI3_Export fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference r[], size_t n,
                                      const fmi3Float64 values[], size_t size) {
  if (n != size) return report(c, fmi3Error, "all variables are scalars");
  return check(c, fmu_set(&((instance *)c)->state, r, n, values));
}

/* The standard asks for all functions. There are no variables of other types, and no clocks. */
static fmi3Status unsupported(const instance *c, size_t n) {
  return n == 0 ? fmi3OK : report(c, fmi3Error, "all variables have the type Float64");
}

#define OTHER_TYPE(Type)                                                                                         \
  FMI3_Export fmi3Status fmi3Get##Type(fmi3Instance c, references r, size_t n, fmi3##Type v[], size_t size) {    \
    return (void)r, (void)v, (void)size, unsupported(c, n);                                                      \
  }                                                                                                              \
  FMI3_Export fmi3Status fmi3Set##Type(fmi3Instance c, references r, size_t n, const fmi3##Type v[],             \
                                       size_t size) {                                                            \
    return (void)r, (void)v, (void)size, unsupported(c, n);                                                      \
  }
OTHER_TYPE(Float32)
OTHER_TYPE(Int8)
OTHER_TYPE(UInt8)
OTHER_TYPE(Int16)
OTHER_TYPE(UInt16)
OTHER_TYPE(Int32)
OTHER_TYPE(UInt32)
OTHER_TYPE(Int64)
OTHER_TYPE(UInt64)
OTHER_TYPE(Boolean)
OTHER_TYPE(String)

#define CLOCK_FUNCTION(Function, One, Two, Three)                                              \
  FMI3_Export fmi3Status Function(fmi3Instance c, references r, size_t n, One, Two, Three) {   \
    return (void)r, (void)one, (void)two, (void)three, unsupported(c, n);                      \
  }
CLOCK_FUNCTION(fmi3GetBinary, size_t one[], fmi3Binary two[], size_t three)
CLOCK_FUNCTION(fmi3SetBinary, const size_t one[], const fmi3Binary two[], size_t three)
CLOCK_FUNCTION(fmi3GetIntervalFraction, fmi3UInt64 one[], fmi3UInt64 two[], fmi3IntervalQualifier three[])

#define PAIR_FUNCTION(Function, One, Two)                                               \
  FMI3_Export fmi3Status Function(fmi3Instance c, references r, size_t n, One, Two) {   \
    return (void)r, (void)one, (void)two, unsupported(c, n);                            \
  }
PAIR_FUNCTION(fmi3GetIntervalDecimal, fmi3Float64 one[], fmi3IntervalQualifier two[])
PAIR_FUNCTION(fmi3GetShiftFraction, fmi3UInt64 one[], fmi3UInt64 two[])
PAIR_FUNCTION(fmi3SetIntervalFraction, const fmi3UInt64 one[], const fmi3UInt64 two[])
PAIR_FUNCTION(fmi3SetShiftFraction, const fmi3UInt64 one[], const fmi3UInt64 two[])

#define SINGLE_FUNCTION(Function, One)                                             \
  FMI3_Export fmi3Status Function(fmi3Instance c, references r, size_t n, One) {   \
    return (void)r, (void)one, unsupported(c, n);                                  \
  }
SINGLE_FUNCTION(fmi3GetClock, fmi3Clock one[])
SINGLE_FUNCTION(fmi3SetClock, const fmi3Clock one[])
SINGLE_FUNCTION(fmi3GetShiftDecimal, fmi3Float64 one[])
SINGLE_FUNCTION(fmi3SetIntervalDecimal, const fmi3Float64 one[])
SINGLE_FUNCTION(fmi3SetShiftDecimal, const fmi3Float64 one[])

FMI3_Export fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time) {
  return (void)clock, (void)time, unsupported(c, 1);
}

FMI3_Export fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference r, size_t *n) {
  return (void)r, (void)n, report(c, fmi3Error, "dependencies are not known at run time");
}

FMI3_Export fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference r, size_t dependents[],
                                                   fmi3ValueReference independents[], size_t elements[],
                                                   fmi3DependencyKind kinds[], size_t n) {
  (void)r, (void)dependents, (void)independents, (void)elements, (void)kinds, (void)n;
  return report(c, fmi3Error, "dependencies are not known at run time");
}

FMI3_Export fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, references unknowns, size_t n, references knowns,
                                                    size_t m, const fmi3Float64 seed[], size_t seed_size,
                                                    fmi3Float64 derivative[], size_t size) {
  if (seed_size != m || size != n) return report(c, fmi3Error, "all variables are scalars");
  return check(c, fmu_get_changes(&((instance *)c)->state, unknowns, n, knowns, m, seed, derivative));
}

FMI3_Export fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, references unknowns, size_t n, references knowns,
                                                size_t m, const fmi3Float64 seed[], size_t seed_size,
                                                fmi3Float64 derivative[], size_t size) {
  (void)unknowns, (void)n, (void)knowns, (void)m, (void)seed, (void)seed_size, (void)derivative, (void)size;
  return report(c, fmi3Error, "there are no adjoint derivatives");
}

FMI3_Export fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference r[], size_t n,
                                                const fmi3Int32 orders[], fmi3Float64 values[], size_t size) {
  (void)r, (void)orders, (void)values, (void)size;
  return n == 0 ? fmi3OK : report(c, fmi3Error, "outputs have no derivatives");
}

/* --- the state --- */

FMI3_Export fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) {
  return check(c, fmu_copy(&((instance *)c)->state, state));
}

FMI3_Export fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) {
  memcpy(&((instance *)c)->state, state, sizeof(fmu));
  return fmi3OK;
}

FMI3_Export fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) {
  return (void)c, fmu_free_copy(state), fmi3OK;
}

FMI3_Export fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) {
  (void)c, (void)state;
  *size = sizeof(fmu);
  return fmi3OK;
}

FMI3_Export fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
  return check(c, fmu_serialize(state, bytes, size));
}

FMI3_Export fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size,
                                               fmi3FMUState *state) {
  return check(c, fmu_deserialize(bytes, size, state));
}

/* --- model exchange --- */

FMI3_Export fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *needs_update, fmi3Boolean *terminates,
                                                fmi3Boolean *nominals_changed, fmi3Boolean *states_changed,
                                                fmi3Boolean *has_next_event, fmi3Float64 *next_event) {
  *needs_update = *terminates = *nominals_changed = *has_next_event = false;
  *states_changed = STOPS > 0;
  *next_event = 0.0;
  return result(c, update_stops(&((instance *)c)->state), fmi3Error);
}

FMI3_Export fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_return, fmi3Boolean *enters_events,
                                                   fmi3Boolean *terminates) {
  (void)c, (void)no_return;
  *enters_events = *terminates = false;
  return fmi3OK;
}

FMI3_Export fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time) {
  ((instance *)c)->state.values[TIME] = time;
  return fmi3OK;
}

FMI3_Export fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 states[], size_t n) {
  return check(c, fmu_set_states(&((instance *)c)->state, states, n));
}

FMI3_Export fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 derivatives[], size_t n) {
  if (n != STATES) return report(c, fmi3Error, WRONG_NUMBER);
  return result(c, fmu_get_derivatives(&((instance *)c)->state, derivatives), fmi3Discard);
}

FMI3_Export fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 indicators[], size_t n) {
  if (n != STOPS) return report(c, fmi3Error, "wrong number of event indicators");
  return result(c, fmu_get_indicators(&((instance *)c)->state, indicators), fmi3Discard);
}

FMI3_Export fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 states[], size_t n) {
  return check(c, fmu_get_states(&((instance *)c)->state, states, n));
}

FMI3_Export fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominals[], size_t n) {
  (void)c;
  for (size_t k = 0; k < n; ++k) nominals[k] = 1.0;
  return fmi3OK;
}

FMI3_Export fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) {
  (void)c;
  *n = STOPS;
  return fmi3OK;
}

FMI3_Export fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) {
  (void)c;
  *n = STATES;
  return fmi3OK;
}

/* --- co-simulation --- */

FMI3_Export fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_return,
                                  fmi3Boolean *needs_events, fmi3Boolean *terminates, fmi3Boolean *is_early,
                                  fmi3Float64 *last_time) {
  fmu *x = &((instance *)c)->state;
  const fmi3Status status = result(c, fmu_advance(x, time + step), fmi3Error);
  (void)no_return;
  *needs_events = *terminates = *is_early = false;
  *last_time = x->values[TIME];
  return status;
}
