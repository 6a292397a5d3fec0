// A mechanism's terms written out as C for it alone: the library that `ckc_pin.generated` compiled and checked.
#pragma once

#include <string>

#include "types.hpp"

namespace ckc {

class Written {
 public:
  // The library at `path`, and the numbers of the mechanism that its code takes.
  Written(const std::string& path, In parameters);
  ~Written();
  Written(const Written&) = delete;

  void place(In q, Out phi, Matrix& J) const;
  void inertia(In q, Matrix& D_tree) const;
  void bias(In q, In v, Out bias_tree, Out J_dot_v, Out damping_tree) const;
  void jacobian_rate(In q, In v, Matrix& J_dot) const;
  double potential_energy(In q) const;
  // Eq. 1, by elimination without pivoting; the least share of a diagonal entry that it leaves.
  double acceleration(In q, In v, In u_tree, In correction, Out acceleration) const;

 private:
  using Code = int (*)(const double**, double**, long long*, double*, int);
  void* symbol(const std::string& name) const;
  Code code(const char* name) const { return reinterpret_cast<Code>(symbol(name)); }
  long long size(const char* of) const;

  void* library_;
  Vector numbers_;  // the parameters, and what follows from them alone
  Code place_, inertia_, bias_, jacobian_rate_, potential_energy_, acceleration_;
};

}  // namespace ckc
