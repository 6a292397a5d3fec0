// A lock that admits one call at a time: `with gate.turn(message)`. A second call raises an exception. Signals cannot
// leave the gate locked.
#include <atomic>
#include <memory>

#include "bind/checks.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

struct Gate {
  std::shared_ptr<std::atomic_flag> locked = std::make_shared<std::atomic_flag>();
  nb::object exception_type;  // type of the exception
};

struct Turn {
  std::shared_ptr<std::atomic_flag> locked;
  nb::object exception_type;
  std::string message;
};

}  // namespace

void bind_gate(nb::module_& m) {
  nb::class_<Turn>(m, "Turn")
      .def("__enter__",
           [](Turn& turn) {
             if (!turn.locked->test_and_set()) return;
             PyErr_SetString(turn.exception_type.ptr(), turn.message.c_str());
             throw nb::python_error();
           })
      .def("__exit__", [](Turn& turn, const nb::args&) { turn.locked->clear(); });
  nb::class_<Gate>(m, "Gate")
      .def(
          "__init__",
          [](Gate* self, nb::object exception_type) {
            new (self) Gate, self->exception_type = std::move(exception_type);
          },
          "refusal"_a)
      // `message`: of the exception that a refused call raises.
      .def(
          "turn",
          [](const Gate& gate, std::string message) {
            return Turn{gate.locked, gate.exception_type, std::move(message)};
          },
          "says"_a);
}

}  // namespace ckc
