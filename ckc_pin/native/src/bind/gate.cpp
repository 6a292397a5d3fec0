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
  nb::class_<Turn>(m, "Turn", "Holds a gate's lock within a `with` block.")
      .def("__enter__",
           [](Turn& turn) {
             if (!turn.locked->test_and_set()) return;
             PyErr_SetString(turn.exception_type.ptr(), turn.message.c_str());
             throw nb::python_error();
           })
      .def(
          "__exit__", [](Turn& turn, const nb::args&) { turn.locked->clear(); },
          nb::sig("def __exit__(self, *args: object) -> None"));
  nb::class_<Gate>(m, "Gate", "A lock that admits one call at a time; a second one raises an exception.")
      .def(
          "__init__",
          [](Gate* self, nb::object exception_type) {
            new (self) Gate, self->exception_type = std::move(exception_type);
          },
          "exception_type"_a, nb::sig("def __init__(self, exception_type: type[Exception]) -> None"))
      .def(
          "turn",
          [](const Gate& gate, std::string message) {
            return Turn{gate.locked, gate.exception_type, std::move(message)};
          },
          "message"_a, "Return a context manager; `message` is that of the exception raised when the lock is taken.");
}

}  // namespace ckc
