#include "loops/compiled_terms.hpp"

#include <dlfcn.h>

#include <cstring>
#include <stdexcept>

namespace ckc {

Written::Written(const std::string& path, In parameters) : library_(dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL)) {
  if (!library_) throw std::runtime_error(dlerror());
  try {
    taken_ = size("numbers_sparsity_in");
    if (taken_ != parameters.size()) throw std::runtime_error(path + ": of another mechanism");
    numbers_.setZero(size("numbers_sparsity_out"));
    given_ = code("numbers", 1);
    vary(parameters);
    place_ = code("place", 3), inertia_ = code("inertia", 3), bias_ = code("bias", 4);
    jacobian_rate_ = code("jacobian_rate", 4), rest_ = code("rest", 3), coriolis_ = perhaps("coriolis", 5);
    potential_energy_ = code("potential_energy", 3), acceleration_ = code("acceleration", 6);
    closing_step_ = code("closing_step", 4), jacobian_ = perhaps("jacobian", 5);
    state_ = perhaps("state", 5), change_ = perhaps("change", 2), changes_ = perhaps("changes", 2);
    groups_ = perhaps("groups", 1);
    if (state_) {
      known_.resize(size("state_sparsity_out") / 8 + 1), acceleration_at_.setZero(size("state_sparsity_out", 1));
      if (changes_) lanes_ = static_cast<int>(size("changes_sparsity_out") / size("change_sparsity_out"));
      directions_ = static_cast<int>(size("change_sparsity_in", 1));
      for (long long k = 0; k < size("groups_sparsity_out"); ++k)
        varied_.push_back(code(("varied_" + std::to_string(k)).c_str(), 2));
    }
  } catch (...) {
    dlclose(library_);
    throw;
  }
}

void Written::vary(In parameters) {
  const double* from[] = {parameters.data()};
  double* to[] = {numbers_.data()};
  given_(from, to, nullptr, nullptr, 0);
  q_.resize(0);
}

Written::~Written() { dlclose(library_); }

void* Written::symbol(const std::string& name) const {
  void* found = dlsym(library_, name.c_str());
  if (!found) throw std::runtime_error("no function " + name + " in the library of a mechanism's terms");
  return found;
}

Written::Code Written::code(const char* name, int arguments) const {
  if (reinterpret_cast<long long (*)()>(symbol(std::string(name) + "_n_in"))() != arguments)
    throw std::runtime_error(std::string("another ") + name + " in the library of a mechanism's terms");
  return reinterpret_cast<Code>(symbol(name));
}

Written::Code Written::perhaps(const char* name, int arguments) const {
  return dlsym(library_, name) ? code(name, arguments) : nullptr;
}

long long Written::size(const char* of, long long k) const {
  return reinterpret_cast<const long long* (*)(long long)>(symbol(of))(k)[0];
}

void Written::place(In q, Out phi, Matrix& J) const {
  const double* from[] = {q.data(), trig(q), numbers_.data()};
  double* to[] = {phi.data(), J.data()};
  place_(from, to, nullptr, nullptr, 0);
}

void Written::inertia(In q, Matrix& D_tree) const {
  const double* from[] = {q.data(), trig(q), numbers_.data()};
  double* to[] = {D_tree.data()};
  inertia_(from, to, nullptr, nullptr, 0);
}

void Written::bias(In q, In v, Out bias_tree, Out J_dot_v, Out damping_tree) const {
  const double* from[] = {q.data(), trig(q), v.data(), numbers_.data()};
  double* to[] = {bias_tree.data(), J_dot_v.data(), damping_tree.data()};
  bias_(from, to, nullptr, nullptr, 0);
}

void Written::jacobian_rate(In q, In v, Matrix& J_dot) const {
  const double* from[] = {q.data(), trig(q), v.data(), numbers_.data()};
  double* to[] = {J_dot.data()};
  jacobian_rate_(from, to, nullptr, nullptr, 0);
}

void Written::rest(In q, Out h_tree) const {
  const double* from[] = {q.data(), trig(q), numbers_.data()};
  double* to[] = {h_tree.data()};
  rest_(from, to, nullptr, nullptr, 0);
}

void Written::coriolis(In q, In v, In x, Out product) const {
  const double* from[] = {q.data(), trig(q), v.data(), x.data(), numbers_.data()};
  double* to[] = {product.data()};
  coriolis_(from, to, nullptr, nullptr, 0);
}

double Written::potential_energy(In q) const {
  double value = 0.0;
  const double* from[] = {q.data(), trig(q), numbers_.data()};
  double* to[] = {&value};
  potential_energy_(from, to, nullptr, nullptr, 0);
  return value;
}

static bool same(In a, const Vector& b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), sizeof(double) * static_cast<size_t>(a.size())) == 0;
}

bool Written::state(In q, In v, In u_tree) const {
  if (!eliminates_) return false;
  return q_.size() && same(q, q_) && same(v, v_) && same(u_tree, u_) ? sound_ : find_state(q, v, u_tree);
}

bool Written::find_state(In q, In v, In u_tree) const {
  q_ = q, v_ = v, u_ = u_tree;
  double sound = 0.0;
  const double* from[] = {q.data(), trig(q), v.data(), u_tree.data(), numbers_.data()};
  double* to[] = {known_.data()->x, acceleration_at_.data(), &sound};
  state_(from, to, nullptr, nullptr, 0);
  return sound_ = sound > 0.0;
}

void Written::change(In direction, Out acceleration) const {
  const double* from[] = {known_.data()->x, direction.data()};
  double* to[] = {acceleration.data()};
  change_(from, to, nullptr, nullptr, 0);
}

void Written::changes(const Matrix& directions, Matrix& acceleration) const {
  const double* from[] = {known_.data()->x, directions.data()};
  double* to[] = {acceleration.data()};
  changes_(from, to, nullptr, nullptr, 0);
}

Indices Written::groups(In varied) const {
  Vector changed(varied_.size());
  const double* from[] = {varied.data()};
  double* to[] = {changed.data()};
  groups_(from, to, nullptr, nullptr, 0);
  Indices found;
  for (Eigen::Index k = 0; k < changed.size(); ++k)
    if (changed(k) != 0.0) found.push_back(static_cast<int>(k));
  return found;
}

void Written::varied(int group, In varied, Out more) const {
  const double* from[] = {known_.data()->x, varied.data()};
  double* to[] = {more.data()};
  varied_[static_cast<size_t>(group)](from, to, nullptr, nullptr, 0);
}

bool Written::eliminate(In q, In v, In u_tree, In correction, Out acceleration) const {
  if (state_ && correction.isZero(0)) {  // what its change needs too is most of it
    if (!find_state(q, v, u_tree)) return false;
    acceleration = acceleration_at_;
    return true;
  }
  double sound = 0.0;
  const double* from[] = {q.data(), trig(q), v.data(), u_tree.data(), correction.data(), numbers_.data()};
  double* to[] = {acceleration.data(), &sound};
  acceleration_(from, to, nullptr, nullptr, 0);
  return sound > 0.0;
}

bool Written::closing_step(In q, In residual, Out x) const {
  if (!eliminates_) return false;
  double sound = 0.0;
  const double* from[] = {q.data(), trig(q), residual.data(), numbers_.data()};
  double* to[] = {x.data(), &sound};
  closing_step_(from, to, nullptr, nullptr, 0);
  return sound > 0.0;
}

bool Written::jacobian(In q, In v, In u_tree, Matrix& by_state, Matrix& by_u) const {
  if (!jacobian_ || !eliminates_) return false;
  const auto size = q.size() + v.size();
  by_state.resize(size, size), by_u.resize(v.size(), v.size());
  double sound = 0.0;
  const double* from[] = {q.data(), trig(q), v.data(), u_tree.data(), numbers_.data()};
  double* to[] = {by_state.data(), by_u.data(), &sound};
  jacobian_(from, to, nullptr, nullptr, 0);
  return sound > 0.0;
}

}  // namespace ckc
