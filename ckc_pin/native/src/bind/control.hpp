// Callers' functions, and what acts, as the loop's bindings take them.
#pragma once

#include <exception>
#include <memory>

#include "bind/checks.hpp"
#include "control/control.hpp"

namespace ckc {

// What a caller's function sees: the state that the loop is at, for as long as the call lasts.
class View : public std::enable_shared_from_this<View> {
 public:
  // Call a function with this; false where it raised, which is kept.
  bool call(const nb::object& function, const Measured& at, Problem& problem, nb::object& answer);

  // A term by name, none when the call is over.
  nb::object term(long stamp, const std::string& name);

  long calls = 0;
  bool asked = false;  // for a term, beside the state's numbers
  std::exception_ptr raised;

 private:
  void put(const Measured& at);

  const Measured* seen_ = nullptr;
  long stamp_ = 0;
  double* data_ = nullptr;  // of numbers_
  nb::object numbers_;
  Places places_;
};

std::unique_ptr<Controller> law_of(const nb::dict& table, const Core& core, Eigen::Index motors,
                                   const std::shared_ptr<View>& view);
std::unique_ptr<Control> control_of(const nb::dict& table, const Core& core, const std::shared_ptr<View>& view);

}  // namespace ckc
