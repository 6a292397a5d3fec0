// Terms compiled as C code for one mechanism: the library that `ckc_pin.codegen` has written, compiled and checked.
#pragma once

#include <string>
#include <vector>

#include "tree/trig.hpp"
#include "tree/widest_registers.hpp"

namespace ckc {

class CompiledTerms {
 public:
  // Load the library at `path` for the given parameters of the mechanism.
  CompiledTerms(const std::string& path, In parameters);
  ~CompiledTerms();
  CompiledTerms(const CompiledTerms&) = delete;

  void set_parameters(In parameters);
  long long parameter_count() const { return parameter_count_; }

  void evaluate_closure(In q, Out phi, Matrix& J) const;
  void evaluate_D_tree(In q, Matrix& D_tree) const;
  void evaluate_bias(In q, In v, Out bias_tree, Out J_dot_v, Out damping_tree) const;
  void evaluate_J_dot(In q, In v, Matrix& J_dot) const;
  void evaluate_h_tree(In q, Out h_tree) const;  // h' without springs
  // C' x. Only if all joints have one degree of freedom: C' of a free root is not unique.
  void multiply_C_tree(In q, In v, In x, Out product) const;
  bool has_coriolis() const { return coriolis_code_; }
  double potential_energy(In q) const;
  // Whether the functions that eliminate without pivoting may be used (loops/elimination_check.hpp decides). If not,
  // they return false; only `eliminate` still computes the acceleration.
  void allow_elimination(bool allowed) { elimination_allowed_ = allowed; }
  bool allows_elimination() const { return elimination_allowed_; }
  // Acceleration of eq. 1 by elimination without pivoting. False if a pivot would be needed.
  bool acceleration(In q, In v, In u_tree, In correction, Out acceleration) const {
    return elimination_allowed_ && eliminate(q, v, u_tree, correction, acceleration);
  }
  bool eliminate(In q, In v, In u_tree, In correction, Out acceleration) const;
  // The same for `members` members of an ensemble at a time, if the library has that function. Arguments and results
  // contain the members' values of one number one after the other. `is_sound` is not positive if a pivot is needed.
  static constexpr int members = 8;
  struct alignas(64) Members {  // one number of each member
    double of[members];
  };
  bool has_accelerations() const { return accelerations_code_ && elimination_allowed_; }
  void accelerations(const Members* q, const Members* trig, const Members* v, const Members* u_tree,
                     const Members* correction, const Members* constants, Members* acceleration,
                     Members* is_sound) const;
  // Other functions of several members, if the library has them. `trig`: cosines and sines of q.
  struct MembersAt {
    const Members *q, *trig, *constants;
  };
  bool has_ends() const { return closures_code_ && elimination_allowed_; }
  void evaluate_closures(const MembersAt& at, Members* phi, Members* J) const;
  void evaluate_J_dots(const MembersAt& at, const Members* v, Members* J_dot) const;
  void evaluate_D_trees(const MembersAt& at, Members* D_tree) const;
  void evaluate_potential_energies(const MembersAt& at, Members* energy) const;
  void closure_steps(const MembersAt& at, const Members* residual, Members* step, Members* is_sound) const;
  const Vector& constants() const { return constants_; }
  // Directional derivatives of the acceleration, if the library has them, at the state of `prepare_derivatives`, which
  // returns false as above. A direction is (derivative of q', of v', `added`), where `added` are the derivatives of u'
  // and of J v'_dot in the rows that the elimination uses. `directional_derivatives` takes `lanes` directions at a
  // time, one per row.
  bool has_directional_derivatives() const { return state_code_; }
  int lanes() const { return lanes_; }
  int direction_size() const { return direction_size_; }
  bool prepare_derivatives(In q, In v, In u_tree) const;
  void directional_derivative(In direction, Out acceleration) const;
  // (lanes, direction_size) -> (lanes, n)
  void directional_derivatives(const Matrix& directions, Matrix& acceleration) const;
  // Groups of parameters that a parameter direction involves, and the contribution of one group to `added`.
  Indices parameter_groups(In direction) const;
  void parameter_direction(int group, In direction, Out added) const;
  // Step x with J x = -residual, minimum-norm in the metric of D'. False as above.
  bool closure_step(In q, In residual, Out x) const;
  // Derivatives of (q'_dot, v'_dot) with respect to (q', v'), and of v'_dot with respect to u'. False as above, or if
  // the library has no such function.
  bool evaluate_jacobian(In q, In v, In u_tree, Matrix& by_state, Matrix& by_u) const;

 private:
  using Code = int (*)(const double**, double**, long long*, double*, int);
  void* find_symbol(const std::string& name) const;
  Code find_code(const char* name, int arguments) const;           // checks the number of arguments
  Code find_optional_code(const char* name, int arguments) const;  // null if the library has none
  // Rows of argument or result k, from a function's table of sparsity patterns.
  long long row_count(const char* sparsity, long long k = 0) const;
  bool compute_state(In q, In v, In u_tree) const;  // evaluates the intermediate results of derivatives

  // Cosines and sines of q, which most functions of one state share.
  const double* trig(In q) const { return trig_.cosines_and_sines(q); }

  void* library_;
  long long parameter_count_ = 0;  // stored because looking it up takes longer than a call
  Vector constants_;               // the parameters and the expressions that depend on nothing else
  mutable Trig trig_;
  struct alignas(64) Line {  // one cache line: numbers that a vector load reads together are in one line
    double x[8];
  };
  // The last state of `prepare_derivatives`, its acceleration, intermediate results, and whether no pivot was needed.
  mutable Vector q_, v_, u_, state_acceleration_;
  mutable std::vector<Line> state_data_;
  mutable bool is_sound_ = false;
  bool elimination_allowed_ = true;
  int lanes_ = 1, direction_size_ = 0;
  Code constants_code_, closure_code_, inertia_code_, bias_code_, J_dot_code_, h_tree_code_, coriolis_code_,
      potential_energy_code_, acceleration_code_, accelerations_code_, closure_step_code_, jacobian_code_;
  Code state_code_, derivative_code_, derivatives_code_, groups_code_;
  Code closures_code_, closure_steps_code_, inertias_code_, potential_energies_code_, J_dots_code_;  // of members
  std::vector<Code> parameter_codes_;
};

inline Vector8& vector_of(CompiledTerms::Members& x) { return reinterpret_cast<Vector8&>(x); }
inline const Vector8& vector_of(const CompiledTerms::Members& x) { return reinterpret_cast<const Vector8&>(x); }

}  // namespace ckc
