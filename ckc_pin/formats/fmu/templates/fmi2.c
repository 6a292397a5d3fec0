/* FMI 2.0 of the FMU. Compile this file alone to a shared library. With -DFMI_HEADERS, it uses the standard's headers. */
#include <stdio.h>
#include <stdlib.h>

#include "fmu.c"

#ifdef FMI_HEADERS
#include "fmi2Functions.h"
#else
#define fmi2True 1
#define fmi2False 0
#ifdef __GNUC__
#define FMI2_Export __attribute__((visibility("default")))
#elif defined _WIN32
#define FMI2_Export __declspec(dllexport)
#else
#define FMI2_Export
#endif
typedef void *fmi2Component, *fmi2ComponentEnvironment, *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer, fmi2Boolean;
typedef const char *fmi2String;
typedef char fmi2Byte;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;
typedef struct {
  void (*logger)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
  void *(*allocateMemory)(size_t, size_t);
  void (*freeMemory)(void *);
  void (*stepFinished)(fmi2ComponentEnvironment, fmi2Status);
  fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;
typedef struct {
  fmi2Boolean newDiscreteStatesNeeded, terminateSimulation, nominalsOfContinuousStatesChanged;
  fmi2Boolean valuesOfContinuousStatesChanged, nextEventTimeDefined;
  fmi2Real nextEventTime;
} fmi2EventInfo;
#endif

typedef struct {
  fmu state;
  fmi2CallbackFunctions callbacks;
  char name[128];
} instance;

static fmi2Status report(const instance *c, fmi2Status status, const char *message) {
  if (c->callbacks.logger != NULL)
    c->callbacks.logger(c->callbacks.componentEnvironment, c->name, status, "logStatusError", "%s", message);
  return status;
}

/* The status of a function that returns NULL or the reason of its failure. */
static fmi2Status check(const instance *c, const char *reason) {
  return reason == NULL ? fmi2OK : report(c, fmi2Error, reason);
}

static fmi2Status result(const instance *c, mech_status status, fmi2Status failure) {
  return status == MECH_OK ? fmi2OK : report(c, failure, REASON[status]);
}

FMI2_Export const char *fmi2GetTypesPlatform(void) { return "default"; }
FMI2_Export const char *fmi2GetVersion(void) { return "2.0"; }

FMI2_Export fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
  return (void)c, (void)on, (void)n, (void)categories, fmi2OK; /* errors are always reported */
}

FMI2_Export fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                                          const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
                                          fmi2Boolean logs) {
  (void)resources, (void)visible, (void)logs;
  instance *c = calloc(1, sizeof *c);
  if (c == NULL) return NULL;
  if (callbacks != NULL) c->callbacks = *callbacks;
  snprintf(c->name, sizeof c->name, "%s", name == NULL ? "" : name);
  fmu_reset(&c->state, type == fmi2ModelExchange);
  if (guid != NULL && strcmp(guid, IDENTITY) == 0) return c;
  report(c, fmi2Error, "the GUID is not that of the model description");
  free(c);
  return NULL;
}

FMI2_Export void fmi2FreeInstance(fmi2Component c) { free(c); }

FMI2_Export fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance,
                                           fmi2Real start, fmi2Boolean has_stop, fmi2Real stop) {
  fmu *x = &((instance *)c)->state;
  (void)has_stop, (void)stop;
  if (has_tolerance && tolerance > 0.0) x->tolerance = tolerance;
  x->values[TIME] = start;
  return fmi2OK;
}

FMI2_Export fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return (void)c, fmi2OK; }

FMI2_Export fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
  fmu *x = &((instance *)c)->state;
  const mech_status status = fmu_assemble(x);
  x->is_initializing = 0;
  return result(c, status, fmi2Error);
}

FMI2_Export fmi2Status fmi2Terminate(fmi2Component c) { return (void)c, fmi2OK; }

FMI2_Export fmi2Status fmi2Reset(fmi2Component c) {
  fmu *x = &((instance *)c)->state;
  fmu_reset(x, x->is_model_exchange);
  return fmi2OK;
}

FMI2_Export fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference references[], size_t n,
                                   fmi2Real values[]) {
  return check(c, fmu_get(&((instance *)c)->state, references, n, values));
}

FMI2_Export fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference references[], size_t n,
                                   const fmi2Real values[]) {
  return check(c, fmu_set(&((instance *)c)->state, references, n, values));
}

/* There are no variables of other types. */
#define OTHER_TYPE(Type)                                                                                          \
  FMI2_Export fmi2Status fmi2Get##Type(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2##Type v[]) { \
    return (void)r, (void)v, n == 0 ? fmi2OK : report(c, fmi2Error, "all variables have the type Real");          \
  }                                                                                                               \
  FMI2_Export fmi2Status fmi2Set##Type(fmi2Component c, const fmi2ValueReference r[], size_t n,                   \
                                       const fmi2##Type v[]) {                                                    \
    return (void)r, (void)v, n == 0 ? fmi2OK : report(c, fmi2Error, "all variables have the type Real");          \
  }
OTHER_TYPE(Integer)
OTHER_TYPE(Boolean)
OTHER_TYPE(String)

FMI2_Export fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
  return check(c, fmu_copy(&((instance *)c)->state, state));
}

FMI2_Export fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
  memcpy(&((instance *)c)->state, state, sizeof(fmu));
  return fmi2OK;
}

FMI2_Export fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
  return (void)c, fmu_free_copy(state), fmi2OK;
}

FMI2_Export fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
  (void)c, (void)state;
  *size = sizeof(fmu);
  return fmi2OK;
}

FMI2_Export fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
  return check(c, fmu_serialize(state, bytes, size));
}

FMI2_Export fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                               fmi2FMUstate *state) {
  return check(c, fmu_deserialize(bytes, size, state));
}

FMI2_Export fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[], size_t n,
                                                    const fmi2ValueReference knowns[], size_t m,
                                                    const fmi2Real seed[], fmi2Real derivative[]) {
  return check(c, fmu_get_changes(&((instance *)c)->state, unknowns, n, knowns, m, seed, derivative));
}

/* --- model exchange --- */

FMI2_Export fmi2Status fmi2EnterEventMode(fmi2Component c) { return (void)c, fmi2OK; }

FMI2_Export fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
  memset(info, 0, sizeof *info);
  info->valuesOfContinuousStatesChanged = STOPS > 0;
  return result(c, update_stops(&((instance *)c)->state), fmi2Error);
}

FMI2_Export fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return (void)c, fmi2OK; }

FMI2_Export fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_return, fmi2Boolean *enters_events,
                                                   fmi2Boolean *terminates) {
  (void)c, (void)no_return;
  *enters_events = *terminates = fmi2False;
  return fmi2OK;
}

FMI2_Export fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) {
  ((instance *)c)->state.values[TIME] = time;
  return fmi2OK;
}

FMI2_Export fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real states[], size_t n) {
  return check(c, fmu_set_states(&((instance *)c)->state, states, n));
}

FMI2_Export fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t n) {
  if (n != STATES) return report(c, fmi2Error, WRONG_NUMBER);
  return result(c, fmu_get_derivatives(&((instance *)c)->state, derivatives), fmi2Discard);
}

FMI2_Export fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real indicators[], size_t n) {
  if (n != STOPS) return report(c, fmi2Error, "wrong number of event indicators");
  return result(c, fmu_get_indicators(&((instance *)c)->state, indicators), fmi2Discard);
}

FMI2_Export fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real states[], size_t n) {
  return check(c, fmu_get_states(&((instance *)c)->state, states, n));
}

FMI2_Export fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real nominals[], size_t n) {
  (void)c;
  for (size_t k = 0; k < n; ++k) nominals[k] = 1.0;
  return fmi2OK;
}

/* --- co-simulation --- */

FMI2_Export fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                                   const fmi2Integer order[], const fmi2Real v[]) {
  return (void)r, (void)order, (void)v, n == 0 ? fmi2OK : report(c, fmi2Error, "inputs have no derivatives");
}

FMI2_Export fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                                    const fmi2Integer order[], fmi2Real v[]) {
  return (void)r, (void)order, (void)v, n == 0 ? fmi2OK : report(c, fmi2Error, "outputs have no derivatives");
}

FMI2_Export fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_return) {
  (void)no_return;
  return result(c, fmu_advance(&((instance *)c)->state, time + step), fmi2Error);
}

FMI2_Export fmi2Status fmi2CancelStep(fmi2Component c) {
  return report(c, fmi2Error, "steps end before fmi2DoStep returns");
}

FMI2_Export fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value) {
  return (void)kind, (void)value, report(c, fmi2Discard, "steps end before fmi2DoStep returns");
}

FMI2_Export fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
  if (kind != fmi2LastSuccessfulTime) return fmi2Discard;
  *value = ((instance *)c)->state.values[TIME];
  return fmi2OK;
}

FMI2_Export fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value) {
  return (void)c, (void)kind, (void)value, fmi2Discard;
}

FMI2_Export fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
  (void)c;
  if (kind != fmi2Terminated) return fmi2Discard;
  *value = fmi2False;
  return fmi2OK;
}

FMI2_Export fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value) {
  return (void)c, (void)kind, (void)value, fmi2Discard;
}
