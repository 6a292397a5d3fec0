/* Drives an FMU 2.0 through its functions, for sanitizers: both kinds of simulation, states, and bad input. */
#include <stdarg.h>

#include "fmi2.c"

static void print_message(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status, fmi2String category,
                          fmi2String format, ...) {
  va_list arguments;
  (void)environment, (void)name, (void)status, (void)category;
  va_start(arguments, format);
  vprintf(format, arguments);
  va_end(arguments);
  printf("\n");
}

static double values[VARIABLES], derivatives[VARIABLES];
static unsigned everything[VARIABLES];

static int set(fmi2Component c, unsigned reference, double value) { return fmi2SetReal(c, &reference, 1, &value); }

/* Euler's method, with the events where an indicator is negative. */
static int exchange(fmi2Component c) {
  fmi2EventInfo info;
  double x[STATES], rates[STATES], indicators[STOP_SIZE];
  int status = fmi2NewDiscreteStates(c, &info) | fmi2EnterContinuousTimeMode(c);
  for (int k = 1; k <= 2000 && status == fmi2OK; ++k) {
    status = fmi2GetContinuousStates(c, x, STATES) | fmi2GetDerivatives(c, rates, STATES);
    for (int i = 0; i < STATES; ++i) x[i] += 1e-4 * rates[i];
    status |= fmi2SetTime(c, 1e-4 * k) | fmi2SetContinuousStates(c, x, STATES);
    status |= fmi2GetEventIndicators(c, indicators, STOPS);
    int has_event = 0;
    for (int i = 0; i < STOPS; ++i) has_event |= indicators[i] < 0.0;
    if (has_event) status |= fmi2EnterEventMode(c) | fmi2NewDiscreteStates(c, &info) | fmi2EnterContinuousTimeMode(c);
  }
  return status;
}

static int run(int is_model_exchange) {
  const fmi2CallbackFunctions calls = {print_message, calloc, free, NULL, NULL};
  const unsigned known = POSITION + INDEPENDENT[0];
  const double seed = 1.0;
  size_t size;
  fmi2FMUstate saved = NULL;
  fmi2Component c = fmi2Instantiate("a", is_model_exchange ? fmi2ModelExchange : fmi2CoSimulation, IDENTITY, NULL, &calls, 0, 1);
  int status = fmi2SetupExperiment(c, 1, 1e-9, 0.0, 0, 0.0) | fmi2EnterInitializationMode(c);
  if (!set(c, PARAMETER, HUGE_VAL) || !set(c, PARAMETER, NAN) || !set(c, EPSILON, 0.0) || !set(c, VARIABLES, 1.0)) return 1;
  status |= fmi2ExitInitializationMode(c) | fmi2GetFMUstate(c, &saved) | fmi2SerializedFMUstateSize(c, saved, &size);
  if (is_model_exchange) status |= exchange(c);
  for (int k = 0; k < 50 && !is_model_exchange; ++k) status |= fmi2DoStep(c, 0.01 * k, 0.01, 1);
  status |= fmi2GetReal(c, everything, VARIABLES, values);
  status |= fmi2GetDirectionalDerivative(c, everything + POSITION, VARIABLES - POSITION, &known, 1, &seed, derivatives);
  if (!fmi2GetDerivatives(c, values, STATES + 1) || !fmi2GetReal(c, (const unsigned[]){VARIABLES}, 1, values)) return 1;
  fmi2Byte *bytes = malloc(size);
  status |= fmi2SerializeFMUstate(c, saved, bytes, size) | fmi2DeSerializeFMUstate(c, bytes, size, &saved);
  if (!fmi2DeSerializeFMUstate(c, bytes, size - 1, &saved)) return 1;
  status |= fmi2SetFMUstate(c, saved) | fmi2FreeFMUstate(c, &saved) | fmi2Reset(c);
  free(bytes);
  fmi2FreeInstance(c);
  return status;
}

int main(void) {
  for (unsigned k = 0; k < VARIABLES; ++k) everything[k] = k;
  return run(0) | run(1);
}
