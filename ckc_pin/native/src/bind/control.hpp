// Calls of the user's functions, and construction of controllers from Python's tables.
#pragma once

#include <exception>
#include <memory>

#include "bind/checks.hpp"
#include "control/control.hpp"
#include "control/forces.hpp"

namespace ckc {

// The state of the loop that a callback can read, valid during the call.
class View : public std::enable_shared_from_this<View> {
 public:
  // Call a function with this view. False if it raised an exception, which is stored.
  bool call(const nb::object& function, const MeasuredState& at, ControlFailure& failure, nb::object& answer);

  // Return a term by name; None after the call has ended.
  nb::object term(long stamp, const std::string& name);

  Vector law_state;  // state of the control law
  long calls = 0;
  bool term_requested = false;  // whether a callback has asked for a term
  std::exception_ptr raised;    // exception of the last call

 private:
  void write_state(const MeasuredState& at);

  const MeasuredState* state_ = nullptr;
  long stamp_ = 0;
  double* data_ = nullptr;  // of numbers_
  nb::object numbers_;
  PartitionLists partition_lists_;
};

std::unique_ptr<Controller> controller_from_table(const nb::dict& table, const Core& core, Eigen::Index motors,
                                                  const std::shared_ptr<View>& view);
std::unique_ptr<Trajectory> trajectory_from_table(const nb::dict& table, int size);
std::unique_ptr<BodyForces> forces_from_tables(const std::vector<nb::dict>& tables, const Core& core,
                                               const std::shared_ptr<View>& view);
void bind_allocation(nb::module_& m);
std::unique_ptr<Control> control_from_table(const nb::dict& table, const Core& core, const std::shared_ptr<View>& view);

}  // namespace ckc
