#include "loops/core.hpp"
#include "loops/articulated_elimination.hpp"
#include "loops/compiled_terms.hpp"
#include "loops/sparse_elimination.hpp"

#include <Eigen/LU>

#include <algorithm>
#include <cmath>

namespace ckc {

// Products with D' are computed densely if D' has more coordinates than the first constant, and a larger share of
// nonzero entries than the second.
constexpr int max_sparse_size = 12;
constexpr double min_dense_share = 0.2;
// Durations in units of a multiplication in projection, which works on dense columns: of one in sparse elimination, and
// of a visit of a coordinate by the sweeps of articulated bodies.
constexpr double sparse_cost = 3.0, visit_cost = 60.0;

Core::Core(CoreTable table)
    : tree(table.model, std::move(table.q_index)),
      constraints(tree, std::move(table.closure)),
      springs(tree, std::move(table.springs)),
      joints(std::move(table.joints), tree.n),
      n(tree.n),
      rank(table.rank),
      scales(std::move(table.scales)),
      d(0),
      compiled(std::move(table.compiled)),
      derivatives(tree, constraints.closure, springs.table),
      independent_rows_(std::move(table.independent_rows)),
      qr_(std::max(constraints.closure.rows, 1), n) {
  const int m = constraints.closure.rows;
  q_tree.setZero(tree.nq), v_tree.setZero(n), bias_tree.setZero(n), bias_without_springs_.setZero(n), h_tree.setZero(n),
      J_dot_v.setZero(m);
  damping_tree.setZero(n);
  x_.setZero(n), y_.setZero(n), elastic_.setZero(n), residual_.setZero(m), rho_dot_q_dot_.setZero(n);
  unbalanced_force_.setZero(n), lambda_.setZero(m), householder_rhs_.setZero(m), minus_residual_.setZero(m);
  tangent_.setZero(n, n - rank), basis_coordinates_.resize(n - rank);
  tangent_matrix_.setZero(n - rank, n - rank), tangent_factor_.resize(n - rank);
  rho_times_x_.setZero(n), tangent_solution_.setZero(n - rank), tangent_rhs_.setZero(n - rank);
  if (table.rotors.size()) tree.set_parameters(Tree::Parameter::rotors, table.rotors);
  size_t entries = 0;
  for (const Indices& rows : tree.inertia_pattern) entries += 2 * rows.size();
  D_tree_is_dense_ = n > max_sparse_size && static_cast<double>(entries) > min_dense_share * n * n;
  choose_elimination();
}

// Use elimination if it costs less than projection: T^T D' T and its Cholesky factorization.
void Core::choose_elimination() {
  sparse_.reset(), articulated_.reset();
  const double size = n, d = n - rank;
  if (compiled || n <= max_sparse_size || static_cast<int>(independent_rows_.size()) != rank) return;
  double inertia_entries = 0.0;
  for (const Indices& rows : tree.inertia_pattern) inertia_entries += 2.0 * static_cast<double>(rows.size()) - 1.0;
  const double products = D_tree_is_dense_ ? rank * size * d : d * inertia_entries + size * d * d;
  const double projection = products + d * d * d / 6.0;
  if (projection < sparse_cost * size) return;
  auto sparse = std::make_unique<SparseElimination>(tree.inertia_pattern, constraints.pattern, independent_rows_);
  const double in_matrices = sparse_cost * static_cast<double>(sparse->operations());
  if (!tree.has_shared_rotors()) {
    auto articulated = std::make_unique<ArticulatedElimination>(tree, constraints, independent_rows_);
    const double by_bodies = visit_cost * static_cast<double>(articulated->visits()) +
                             sparse_cost * static_cast<double>(articulated->operations());
    if (by_bodies < std::min(projection, in_matrices)) articulated_ = std::move(articulated);
  }
  if (!articulated_ && in_matrices < projection) sparse_ = std::move(sparse);
}

Core::~Core() = default;

void Core::set_partition(Indices q_, Indices z_) {
  q = std::move(q_), z = std::move(z_);
  d = static_cast<int>(q.size());
  const int m = constraints.closure.rows, k = static_cast<int>(z.size());
  const auto [pattern, places] = constraints.in_columns(z);
  phi_z.set_pattern(m, k, pattern, places), basis_.set_pattern(m, k, pattern, places);
  basis_q_ = q, basis_z_ = z, basis_configuration_ = -1;
  D_factor.resize(d);
  rho.setZero(n, d), D.setZero(d, d), this->z_.setZero(k), d_.setZero(d);
}

Eigen::Index Core::parameter_size(Parameter parameter) const {
  const Eigen::Index m = constraints.closure.rows;
  switch (parameter) {
    case Parameter::gravity: return 3;
    case Parameter::offset:
    case Parameter::centre: return 3 * tree.joints;
    case Parameter::mass: return tree.joints;
    case Parameter::inertia: return 9 * tree.joints;
    case Parameter::point: return 3 * static_cast<Eigen::Index>(constraints.closure.point_local.size());
    case Parameter::length:
    case Parameter::affine_offset: return m;
    case Parameter::affine: return m * n;
    case Parameter::rotors: return n * n;
    case Parameter::end: return 6 * springs.count();
    case Parameter::stiffness:
    case Parameter::rest_length:
    case Parameter::damping: return springs.count();
    case Parameter::compiled: return compiled ? compiled->parameter_count() : 0;
    default: return n;
  }
}

void Core::set_parameters(Parameter parameter, In values) {
  const int k = static_cast<int>(parameter);
  const auto offset_from = [k](Parameter first) { return k - static_cast<int>(first); };
  if (parameter == Parameter::compiled)
    compiled->set_parameters(values);
  else if (parameter >= Parameter::end)
    springs.set_parameters(static_cast<Springs::Parameter>(offset_from(Parameter::end)), values);
  else if (parameter >= Parameter::point)
    constraints.set_parameters(static_cast<ConstraintRows::Parameter>(offset_from(Parameter::point)), values);
  else
    tree.set_parameters(static_cast<Tree::Parameter>(k), values);
  if (parameter == Parameter::rotors) D_tree_.resize(0, 0), choose_elimination();  // they couple other coordinates
  valid_parts_ = 0, basis_configuration_ = -1, ++configuration_count;
}

bool Core::has_negative_determinant() {
  if (constraints.closure.rows != static_cast<int>(z.size()) || z.empty()) return false;
  Matrix square(z.size(), z.size());
  compute_J();
  for (size_t k = 0; k < z.size(); ++k) square.col(k) = constraints.J().col(z[k]);
  return square.partialPivLu().determinant() < 0.0;
}

void Core::set_configuration(In q_tree_, bool with_inertia) {
  ++configuration_count;
  q_tree = q_tree_;
  Profile::Entry entry(profile, with_inertia && !compiled ? Profile::D_tree : Profile::phi);
  if (compiled) {
    compiled->evaluate_closure(q_tree, constraints.phi, constraints.J_to_set());
    if (has_row_motion()) constraints.phi -= row_motion.value;
    valid_parts_ = jacobian_of_rows;
    return;
  }
  const bool needs_D = with_inertia && !eliminates_by_bodies();
  if (needs_D)
    tree.compute_D(q_tree), set_D_tree();
  else
    tree.set_configuration(q_tree);
  valid_parts_ = (needs_D ? inertia_of_tree : 0u) | tree_is_set;
  constraints.update(tree, q_tree);
  if (has_row_motion()) constraints.phi -= row_motion.value;
}

void Core::set_velocity(In v) {
  if (v_tree == v) return;
  v_tree = v;
  valid_parts_ &= ~(row_rates | bias_of_tree | coriolis_of_tree);
}

// Evaluate Pinocchio's tree, for quantities that the compiled terms do not provide.
void Core::update_tree() {
  if (is_valid(tree_is_set)) return;
  tree.set_configuration(q_tree);
  constraints.update(tree, q_tree);
  if (has_row_motion()) constraints.phi -= row_motion.value;
  valid_parts_ |= tree_is_set;
}

void Core::compute_J() {
  if (is_valid(jacobian_of_rows)) return;
  Profile::Entry entry(profile, Profile::J);
  constraints.update_jacobian(tree);
  valid_parts_ |= jacobian_of_rows;
}

void Core::factorize_phi_z() {
  if (is_valid(factor_of_phi_z)) return;
  compute_J();
  Profile::Entry entry(profile, Profile::phi_z);
  phi_z.compute(constraints.J_entries());
  valid_parts_ |= factor_of_phi_z;
}

void Core::compute_rho() {
  if (is_valid(rho_of_phi_z)) return;
  factorize_phi_z();
  Profile::Entry entry(profile, Profile::rho);
  for (int k = 0; k < d; ++k) {
    constraints.J_column(q[k], residual_);
    phi_z.solve(residual_, z_);
    for (int i = 0; i < d; ++i) rho(q[i], k) = 0.0;
    rho(q[k], k) = 1.0;
    for (size_t i = 0; i < z.size(); ++i) rho(z[i], k) = -z_(i);
  }
  valid_parts_ |= rho_of_phi_z;
}

void Core::compute_D_tree() {
  if (is_valid(inertia_of_tree)) return;
  Profile::Entry entry(profile, Profile::D_tree);
  valid_parts_ |= inertia_of_tree;
  if (!compiled) return tree.compute_D(q_tree), set_D_tree();
  if (!D_tree_.size()) D_tree_.setZero(n, n);
  compiled->evaluate_D_tree(q_tree, D_tree_);
  D_compiled_entries_.clear();
  for (int j = 0; j < n; ++j)
    for (int i : tree.inertia_pattern[j]) D_compiled_entries_.push_back(D_tree_(i, j));
}

void Core::set_D_tree() {
  if (!D_tree_is_dense_) return;
  if (!D_tree_.size()) D_tree_.setZero(n, n);
  const double* entry = tree.D_entries().data();
  for (int j = 0; j < n; ++j)
    for (int i : tree.inertia_pattern[j]) D_tree_(i, j) = *entry++;
}

void Core::compute_D() {
  if (is_valid(inertia_of_q)) return;
  compute_D_tree(), compute_rho();
  Profile::Entry entry(profile, Profile::D);
  restrict_inertia(q, rho, D);
  D_factor.compute(D);
  valid_parts_ |= inertia_of_q;
}

// basis^T D' basis, where the rows of the independent coordinates are those of the identity.
void Core::restrict_inertia(const Indices& independent, const Matrix& basis, Matrix& restricted) {
  const auto count = static_cast<int>(independent.size());
  if (!D_tree_is_dense_) {
    D_basis_.resize(n, count);
    for (int k = 0; k < count; ++k) multiply_D_tree(basis.col(k), D_basis_.col(k));
    for (int i = 0; i < count; ++i)
      for (int k = 0; k < count; ++k) restricted(i, k) = basis.col(i).dot(D_basis_.col(k));
    return;
  }
  // [1; S]^T [A, B; B^T, C] [1; S] = A + X + X^T with X = (B + S^T C / 2) S
  dependent_.clear();
  for (int k = 0; k < n; ++k)
    if (std::find(independent.begin(), independent.end(), k) == independent.end()) dependent_.push_back(k);
  const auto entry = [this](int i, int j) { return i <= j ? D_tree_(i, j) : D_tree_(j, i); };
  const int others = n - count;
  dependent_basis_.resize(others, count), D_dependent_.resize(others, others), D_between_.resize(count, others);
  for (int j = 0; j < others; ++j) {
    dependent_basis_.row(j) = basis.row(dependent_[j]);
    for (int i = 0; i < others; ++i) D_dependent_(i, j) = 0.5 * entry(dependent_[i], dependent_[j]);
    for (int i = 0; i < count; ++i) D_between_(i, j) = entry(independent[i], dependent_[j]);
  }
  D_between_.noalias() += dependent_basis_.transpose() * D_dependent_;
  D_basis_.noalias() = D_between_ * dependent_basis_;
  for (int j = 0; j < count; ++j)
    for (int i = 0; i < count; ++i)
      restricted(i, j) = entry(independent[i], independent[j]) + (D_basis_(i, j) + D_basis_(j, i));
}

void Core::multiply_D_tree(In x, Out product) const {
  const double* value = D_entries().data();
  product.setZero();
  for (int j = 0; j < n; ++j) {
    double sum = 0.0, diagonal = 0.0;
    for (int i : tree.inertia_pattern[j]) {
      const double entry = *value++;
      if (i == j) {
        diagonal = entry;
        continue;
      }
      product(i) += entry * x(j);
      sum += entry * x(i);
    }
    product(j) += sum + diagonal * x(j);
  }
}

double Core::joint_inertia(int k) {
  const bool is_factorized = elimination_is_accurate_ && factors_configuration_ == configuration_count;
  if (eliminates_by_bodies() && is_factorized) return articulated_->bodies.inertia(k);
  compute_D_tree();
  return D_entries()[tree.D_diagonal[k]];
}

double Core::potential_energy() {
  if (compiled) return compiled->potential_energy(q_tree);
  update_spring_lengths();
  return tree.potential_energy(q_tree) + springs.energy(tree, q_tree);
}

Energy Core::energy(In v, Out momentum) {
  compute_D_tree();
  multiply_D_tree(v, momentum);
  return {0.5 * v.dot(momentum), potential_energy()};
}

void Core::multiply_rho(In q_dot, Out v) const {
  v.setZero();
  for (int k = 0; k < d; ++k) v += q_dot(k) * rho.col(k);
}

void Core::multiply_rho_transposed(In force, Out generalized) const {
  for (int k = 0; k < d; ++k) generalized(k) = rho.col(k).dot(force);
}

// Compute the velocities of the tree, and from them the rates of the constraint rows.
void Core::update_row_rates() {
  if (is_valid(row_rates)) return;
  update_tree();
  const bool has_small_pivot = factors_configuration_ == configuration_count && !elimination_is_accurate_;
  if (eliminates_by_bodies() && !has_small_pivot) {
    ArticulatedBodies& bodies = placed_bodies();
    bias_without_springs_ = bodies.compute_bias(v_tree);
    constraints.update_rates(tree, bodies, v_tree);
  } else {
    bias_without_springs_ = tree.compute_bias(q_tree, v_tree);
    constraints.update_rates(tree, tree, v_tree);
  }
  valid_parts_ |= row_rates;
}

void Core::compute_J_dot(In v) {
  if (compiled) return compiled->evaluate_J_dot(q_tree, v, constraints.J_dot);
  set_velocity(v);
  update_row_rates();
  constraints.update_jacobian_dot(tree, tree.compute_jacobian_dot(q_tree, v_tree));
}

// With free roots, tangent steps do not commute with v', which adds J bracket_matrix(v).
void Core::constraint_rate_derivative(In v, Matrix& by_q) {
  compute_J_dot(v);
  by_q = constraints.J_dot;
  if (!tree.roots.empty()) compute_J(), by_q.noalias() -= constraints.J() * tree.bracket_matrix(v);
}

void Core::compute_bias() {
  if (is_valid(bias_of_tree)) return;
  Profile::Entry entry(profile, Profile::bias_tree);
  valid_parts_ |= bias_of_tree;
  if (compiled) return compiled->evaluate_bias(q_tree, v_tree, bias_tree, J_dot_v, damping_tree);
  update_row_rates();
  constraints.bias(J_dot_v);
  bias_tree = bias_without_springs_;
  if (springs.has_elastic_forces) compute_spring_forces(), bias_tree -= elastic_;
  if (!springs.has_damping) return;
  update_spring_lengths(), damping_tree.setZero();
  springs.add_damping_force(v_tree, damping_tree);
}

void Core::compute_spring_forces() {
  update_spring_lengths(), elastic_.setZero();
  springs.add_elastic_force(tree, q_tree, elastic_);
}

void Core::update_spring_lengths() {
  if (is_valid(lengths_of_springs)) return;
  update_tree();
  if (springs.has_elastic_forces || springs.has_damping) springs.update_lengths(tree);
  valid_parts_ |= lengths_of_springs;
}

void Core::compute_coriolis() {
  if (is_valid(coriolis_of_tree)) return;
  Profile::Entry entry(profile, Profile::C_tree);
  valid_parts_ |= coriolis_of_tree;
  if (compiled && compiled->has_coriolis()) {
    compute_J_dot(v_tree);
    return compiled->evaluate_h_tree(q_tree, h_tree);
  }
  update_row_rates();
  C_tree_ = tree.compute_coriolis(q_tree, v_tree);
  constraints.update_jacobian_dot(tree, tree.jacobian_dot());
  h_tree = tree.compute_gravity(q_tree);
  if (springs.has_elastic_forces) compute_spring_forces(), h_tree -= elastic_;
}

void Core::multiply_C_tree(In x, Out product) {
  if (compiled && compiled->has_coriolis())
    compiled->multiply_C_tree(q_tree, v_tree, x, product);
  else
    product.noalias() = C_tree_ * x;
}

void Core::multiply_rho_dot(In x, Out product) {
  multiply_rho(x, rho_times_x_);
  residual_.noalias() = -constraints.J_dot * rho_times_x_;
  phi_z.solve(residual_, z_);
  product.setZero();
  for (size_t i = 0; i < z.size(); ++i) product(z[i]) = z_(i);
}

void Core::multiply_C(In x, Out product) {
  multiply_rho_dot(x, x_);
  multiply_D_tree(x_, y_);
  multiply_rho(x, x_);
  multiply_C_tree(x_, rho_times_x_);
  y_ += rho_times_x_;
  multiply_rho_transposed(y_, product);
}

void Core::reduced_acceleration(In u_tree, Out q_ddot) {
  compute_D(), compute_bias();
  residual_ = -J_dot_v;
  phi_z.solve(residual_, z_);  // from J rho = 0, differentiated
  rho_dot_q_dot_.setZero();
  for (size_t i = 0; i < z.size(); ++i) rho_dot_q_dot_(z[i]) = z_(i);
  multiply_D_tree(rho_dot_q_dot_, y_);
  x_ = u_tree - bias_tree - y_ + damping_tree;
  multiply_rho_transposed(x_, d_);
  D_factor.solve(d_, q_ddot);
}

void Core::tree_acceleration(In q_ddot, Out a) const {
  a = rho_dot_q_dot_;
  for (int k = 0; k < d; ++k) a += q_ddot(k) * rho.col(k);
}

void Core::actual_acceleration(In u_tree, In q_dot, Out q_ddot) {
  compute_D(), compute_bias(), compute_coriolis();
  multiply_C(q_dot, d_);
  x_ = u_tree - h_tree + damping_tree;
  for (int k = 0; k < d; ++k) d_(k) = rho.col(k).dot(x_) - d_(k);
  D_factor.solve(d_, q_ddot);
}

void Core::spf_z_dot(In q_dot, double epsilon, In w, Out z_dot) {
  phi_z.solve(w, z_dot);
  for (size_t i = 0; i < z.size(); ++i) z_dot(i) = rho.row(z[i]).dot(q_dot) - z_dot(i) / epsilon;
}

}  // namespace ckc
