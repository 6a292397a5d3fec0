#include "written.hpp"

#include <dlfcn.h>

#include <stdexcept>

namespace ckc {

Written::Written(const std::string& path, In parameters) : library_(dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL)) {
  if (!library_) throw std::runtime_error(dlerror());
  try {
    if (size("numbers_sparsity_in") != parameters.size()) throw std::runtime_error(path + ": of another mechanism");
    numbers_.setZero(size("numbers_sparsity_out"));
    const double* from[] = {parameters.data()};
    double* to[] = {numbers_.data()};
    code("numbers")(from, to, nullptr, nullptr, 0);
    place_ = code("place"), inertia_ = code("inertia"), bias_ = code("bias"), jacobian_rate_ = code("jacobian_rate");
    potential_energy_ = code("potential_energy"), acceleration_ = code("acceleration");
  } catch (...) {
    dlclose(library_);
    throw;
  }
}

Written::~Written() { dlclose(library_); }

void* Written::symbol(const std::string& name) const {
  void* found = dlsym(library_, name.c_str());
  if (!found) throw std::runtime_error("no function " + name + " in the library of a mechanism's terms");
  return found;
}

long long Written::size(const char* of) const {
  return reinterpret_cast<const long long* (*)(long long)>(symbol(of))(0)[0];
}

void Written::place(In q, Out phi, Matrix& J) const {
  const double* from[] = {q.data(), numbers_.data()};
  double* to[] = {phi.data(), J.data()};
  place_(from, to, nullptr, nullptr, 0);
}

void Written::inertia(In q, Matrix& D_tree) const {
  const double* from[] = {q.data(), numbers_.data()};
  double* to[] = {D_tree.data()};
  inertia_(from, to, nullptr, nullptr, 0);
}

void Written::bias(In q, In v, Out bias_tree, Out J_dot_v, Out damping_tree) const {
  const double* from[] = {q.data(), v.data(), numbers_.data()};
  double* to[] = {bias_tree.data(), J_dot_v.data(), damping_tree.data()};
  bias_(from, to, nullptr, nullptr, 0);
}

void Written::jacobian_rate(In q, In v, Matrix& J_dot) const {
  const double* from[] = {q.data(), v.data(), numbers_.data()};
  double* to[] = {J_dot.data()};
  jacobian_rate_(from, to, nullptr, nullptr, 0);
}

double Written::potential_energy(In q) const {
  double value = 0.0;
  const double* from[] = {q.data(), numbers_.data()};
  double* to[] = {&value};
  potential_energy_(from, to, nullptr, nullptr, 0);
  return value;
}

double Written::acceleration(In q, In v, In u_tree, In correction, Out acceleration) const {
  double share = 0.0;
  const double* from[] = {q.data(), v.data(), u_tree.data(), correction.data(), numbers_.data()};
  double* to[] = {acceleration.data(), &share};
  acceleration_(from, to, nullptr, nullptr, 0);
  return share;
}

}  // namespace ckc
