// One call at a time: `with` of a gate's turns, without a moment at which a signal could leave the gate shut.
#include <atomic>
#include <memory>

#include "bind/checks.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

struct Gate {
  std::shared_ptr<std::atomic_flag> shut = std::make_shared<std::atomic_flag>();
  nb::object refusal;  // an exception's type
};

struct Turn {
  std::shared_ptr<std::atomic_flag> shut;
  nb::object refusal;
  std::string says;
};

}  // namespace

void bind_gate(nb::module_& m) {
  nb::class_<Turn>(m, "Turn")
      .def("__enter__",
           [](Turn& turn) {
             if (!turn.shut->test_and_set()) return;
             PyErr_SetString(turn.refusal.ptr(), turn.says.c_str());
             throw nb::python_error();
           })
      .def("__exit__", [](Turn& turn, const nb::args&) { turn.shut->clear(); });
  nb::class_<Gate>(m, "Gate")
      .def("__init__", [](Gate* self, nb::object refusal) { new (self) Gate, self->refusal = std::move(refusal); }, "refusal"_a)
      // Of who says that when it is refused.
      .def("turn", [](const Gate& gate, std::string says) { return Turn{gate.shut, gate.refusal, std::move(says)}; }, "says"_a);
}

}  // namespace ckc
