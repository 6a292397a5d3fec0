#include "loops/compiled_terms.hpp"

#include <dlfcn.h>

#include <cstring>
#include <stdexcept>

namespace ckc {

// Call a function with its arguments and the places of its results.
template <class Code, size_t arguments, size_t results>
static void call(Code code, const double* (&&from)[arguments], double* (&&to)[results]) {
  code(from, to, nullptr, nullptr, 0);
}

CompiledTerms::CompiledTerms(const std::string& path, In parameters)
    : library_(dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL)) {
  if (!library_) throw std::runtime_error(dlerror());
  try {
    parameter_count_ = row_count("numbers_sparsity_in");
    if (parameter_count_ != parameters.size()) throw std::runtime_error(path + ": of another mechanism");
    constants_.setZero(row_count("numbers_sparsity_out"));
    constants_code_ = find_code("numbers", 1);
    set_parameters(parameters);
    closure_code_ = find_code("place", 3), inertia_code_ = find_code("inertia", 3), bias_code_ = find_code("bias", 4);
    J_dot_code_ = find_code("jacobian_rate", 4), h_tree_code_ = find_code("rest", 3),
    coriolis_code_ = find_optional_code("coriolis", 5);
    potential_energy_code_ = find_code("potential_energy", 3), acceleration_code_ = find_code("acceleration", 6),
    accelerations_code_ = find_optional_code("acceleration_of_members", 6);
    closures_code_ = find_optional_code("place_of_members", 3);
    closure_steps_code_ = find_optional_code("closing_step_of_members", 4);
    inertias_code_ = find_optional_code("inertia_of_members", 3);
    potential_energies_code_ = find_optional_code("potential_energy_of_members", 3);
    J_dots_code_ = find_optional_code("jacobian_rate_of_members", 4);
    closure_step_code_ = find_code("closing_step", 4), jacobian_code_ = find_optional_code("jacobian", 5);
    state_code_ = find_optional_code("state", 5), derivative_code_ = find_optional_code("change", 2),
    derivatives_code_ = find_optional_code("changes", 2);
    groups_code_ = find_optional_code("groups", 1);
    if (state_code_) {
      state_data_.resize(row_count("state_sparsity_out") / 8 + 1),
          state_acceleration_.setZero(row_count("state_sparsity_out", 1));
      if (derivatives_code_)
        lanes_ = static_cast<int>(row_count("changes_sparsity_out") / row_count("change_sparsity_out"));
      direction_size_ = static_cast<int>(row_count("change_sparsity_in", 1));
      for (long long k = 0; k < row_count("groups_sparsity_out"); ++k)
        parameter_codes_.push_back(find_code(("varied_" + std::to_string(k)).c_str(), 2));
    }
  } catch (...) {
    dlclose(library_);
    throw;
  }
}

void CompiledTerms::set_parameters(In parameters) {
  call(constants_code_, {parameters.data()}, {constants_.data()});
  q_.resize(0);
}

CompiledTerms::~CompiledTerms() { dlclose(library_); }

void* CompiledTerms::find_symbol(const std::string& name) const {
  void* symbol = dlsym(library_, name.c_str());
  if (!symbol) throw std::runtime_error("no function " + name + " in the library of a mechanism's terms");
  return symbol;
}

CompiledTerms::Code CompiledTerms::find_code(const char* name, int arguments) const {
  if (reinterpret_cast<long long (*)()>(find_symbol(std::string(name) + "_n_in"))() != arguments)
    throw std::runtime_error(std::string("another ") + name + " in the library of a mechanism's terms");
  return reinterpret_cast<Code>(find_symbol(name));
}

CompiledTerms::Code CompiledTerms::find_optional_code(const char* name, int arguments) const {
  return dlsym(library_, name) ? find_code(name, arguments) : nullptr;
}

long long CompiledTerms::row_count(const char* sparsity, long long k) const {
  return reinterpret_cast<const long long* (*)(long long)>(find_symbol(sparsity))(k)[0];
}

void CompiledTerms::evaluate_closure(In q, Out phi, Matrix& J) const {
  call(closure_code_, {q.data(), trig(q), constants_.data()}, {phi.data(), J.data()});
}

void CompiledTerms::evaluate_D_tree(In q, Matrix& D_tree) const {
  call(inertia_code_, {q.data(), trig(q), constants_.data()}, {D_tree.data()});
}

void CompiledTerms::evaluate_bias(In q, In v, Out bias_tree, Out J_dot_v, Out damping_tree) const {
  call(bias_code_, {q.data(), trig(q), v.data(), constants_.data()},
       {bias_tree.data(), J_dot_v.data(), damping_tree.data()});
}

void CompiledTerms::evaluate_J_dot(In q, In v, Matrix& J_dot) const {
  call(J_dot_code_, {q.data(), trig(q), v.data(), constants_.data()}, {J_dot.data()});
}

void CompiledTerms::evaluate_h_tree(In q, Out h_tree) const {
  call(h_tree_code_, {q.data(), trig(q), constants_.data()}, {h_tree.data()});
}

void CompiledTerms::multiply_C_tree(In q, In v, In x, Out product) const {
  call(coriolis_code_, {q.data(), trig(q), v.data(), x.data(), constants_.data()}, {product.data()});
}

double CompiledTerms::potential_energy(In q) const {
  double value = 0.0;
  call(potential_energy_code_, {q.data(), trig(q), constants_.data()}, {&value});
  return value;
}

static bool is_identical(In a, const Vector& b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), sizeof(double) * static_cast<size_t>(a.size())) == 0;
}

bool CompiledTerms::prepare_derivatives(In q, In v, In u_tree) const {
  if (!elimination_allowed_) return false;
  const bool is_current = q_.size() && is_identical(q, q_) && is_identical(v, v_) && is_identical(u_tree, u_);
  return is_current ? is_sound_ : compute_state(q, v, u_tree);
}

bool CompiledTerms::compute_state(In q, In v, In u_tree) const {
  q_ = q, v_ = v, u_ = u_tree;
  double is_sound = 0.0;
  call(state_code_, {q.data(), trig(q), v.data(), u_tree.data(), constants_.data()},
       {state_data_.data()->x, state_acceleration_.data(), &is_sound});
  return is_sound_ = is_sound > 0.0;
}

void CompiledTerms::directional_derivative(In direction, Out acceleration) const {
  call(derivative_code_, {state_data_.data()->x, direction.data()}, {acceleration.data()});
}

void CompiledTerms::directional_derivatives(const Matrix& directions, Matrix& acceleration) const {
  call(derivatives_code_, {state_data_.data()->x, directions.data()}, {acceleration.data()});
}

Indices CompiledTerms::parameter_groups(In direction) const {
  Vector is_involved(parameter_codes_.size());
  call(groups_code_, {direction.data()}, {is_involved.data()});
  Indices groups;
  for (Eigen::Index k = 0; k < is_involved.size(); ++k)
    if (is_involved(k) != 0.0) groups.push_back(static_cast<int>(k));
  return groups;
}

void CompiledTerms::parameter_direction(int group, In direction, Out added) const {
  call(parameter_codes_[static_cast<size_t>(group)], {state_data_.data()->x, direction.data()}, {added.data()});
}

bool CompiledTerms::eliminate(In q, In v, In u_tree, In correction, Out acceleration) const {
  // The function that prepares derivatives computes the acceleration too, at little extra cost.
  if (state_code_ && correction.isZero(0)) {
    if (!compute_state(q, v, u_tree)) return false;
    acceleration = state_acceleration_;
    return true;
  }
  double is_sound = 0.0;
  call(acceleration_code_, {q.data(), trig(q), v.data(), u_tree.data(), correction.data(), constants_.data()},
       {acceleration.data(), &is_sound});
  return is_sound > 0.0;
}

void CompiledTerms::accelerations(const Members* q, const Members* trig, const Members* v, const Members* u_tree,
                                  const Members* correction, const Members* constants, Members* acceleration,
                                  Members* is_sound) const {
  call(accelerations_code_, {q->of, trig->of, v->of, u_tree->of, correction->of, constants->of},
       {acceleration->of, is_sound->of});
}

void CompiledTerms::evaluate_closures(const MembersAt& at, Members* phi, Members* J) const {
  call(closures_code_, {at.q->of, at.trig->of, at.constants->of}, {phi->of, J->of});
}

void CompiledTerms::evaluate_J_dots(const MembersAt& at, const Members* v, Members* J_dot) const {
  call(J_dots_code_, {at.q->of, at.trig->of, v->of, at.constants->of}, {J_dot->of});
}

void CompiledTerms::evaluate_D_trees(const MembersAt& at, Members* D_tree) const {
  call(inertias_code_, {at.q->of, at.trig->of, at.constants->of}, {D_tree->of});
}

void CompiledTerms::evaluate_potential_energies(const MembersAt& at, Members* energy) const {
  call(potential_energies_code_, {at.q->of, at.trig->of, at.constants->of}, {energy->of});
}

void CompiledTerms::closure_steps(const MembersAt& at, const Members* residual, Members* step,
                                  Members* is_sound) const {
  call(closure_steps_code_, {at.q->of, at.trig->of, residual->of, at.constants->of}, {step->of, is_sound->of});
}

bool CompiledTerms::closure_step(In q, In residual, Out x) const {
  if (!elimination_allowed_) return false;
  double is_sound = 0.0;
  call(closure_step_code_, {q.data(), trig(q), residual.data(), constants_.data()}, {x.data(), &is_sound});
  return is_sound > 0.0;
}

bool CompiledTerms::evaluate_jacobian(In q, In v, In u_tree, Matrix& by_state, Matrix& by_u) const {
  if (!jacobian_code_ || !elimination_allowed_) return false;
  const auto state_size = q.size() + v.size();
  by_state.resize(state_size, state_size), by_u.resize(v.size(), v.size());
  double is_sound = 0.0;
  call(jacobian_code_, {q.data(), trig(q), v.data(), u_tree.data(), constants_.data()},
       {by_state.data(), by_u.data(), &is_sound});
  return is_sound > 0.0;
}

}  // namespace ckc
