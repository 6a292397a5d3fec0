#include "loops/core.hpp"
#include "loops/compiled_terms.hpp"

#include <Eigen/LU>

#include <algorithm>
#include <cmath>

namespace ckc {

constexpr int small = 12;        // coordinates
constexpr double crowded = 0.2;  // share of D' that is not zero, from which a product with all of it costs less

Core::Core(const std::string& model, Indices place, Closure closure, SpringTable table, JointTable joint_table,
           int rank_, Scales scales_, std::unique_ptr<Written> written_)
    : tree(model, std::move(place)),
      rows(tree, std::move(closure)),
      springs(tree, std::move(table)),
      joints(std::move(joint_table), tree.n),
      n(tree.n),
      rank(rank_),
      scales(std::move(scales_)),
      d(0),
      written(std::move(written_)),
      derivatives(tree, rows.closure, springs.table),
      qr_(std::max(rows.closure.rows, 1), n) {
  const int m = rows.closure.rows;
  q_tree.setZero(tree.nq), v_tree.setZero(n), bias_tree.setZero(n), bias_without_springs_.setZero(n), h_tree.setZero(n), J_dot_v.setZero(m);
  C_tree_.setZero(n, n), damping_tree.setZero(n), D_written_.setZero(n, n);
  x_.setZero(n), y_.setZero(n), elastic_.setZero(n), residual_.setZero(m), rho_dot_q_dot_.setZero(n);
  effort_.setZero(n), lambda_.setZero(m), turned_.setZero(m), negative_.setZero(m);
  tangent_.setZero(n, n - rank), D_tangent_.setZero(n, n - rank), free_.resize(n - rank);
  square_.setZero(n - rank, n - rank), square_factor_.shape(n - rank);
  moved_.setZero(n), small_.setZero(n - rank), small_b_.setZero(n - rank);
  size_t entries = 0;
  for (const Indices& above : tree.ancestors) entries += 2 * above.size();
  dense_ = n > small && static_cast<double>(entries) > crowded * n * n;
}

Core::~Core() = default;

void Core::split(Indices q_, Indices z_) {
  q = std::move(q_), z = std::move(z_);
  d = static_cast<int>(q.size());
  const int m = rows.closure.rows, k = static_cast<int>(z.size());
  const auto pattern = rows.pattern_of(z, n);
  phi_z.shape(m, k, pattern), basis_.shape(m, k, pattern);
  basis_q_ = q, basis_z_ = z, basis_at_ = -1;
  D_factor.shape(d);
  rho.setZero(n, d), D_rho_.setZero(n, d), D.setZero(d, d), this->z_.setZero(k), d_.setZero(d);
}

Eigen::Index Core::size_of(Number what) const {
  const Eigen::Index m = rows.closure.rows;
  switch (what) {
    case Number::gravity: return 3;
    case Number::offset: case Number::centre: return 3 * tree.joints;
    case Number::mass: return tree.joints;
    case Number::inertia: return 9 * tree.joints;
    case Number::point: return 3 * static_cast<Eigen::Index>(rows.closure.point_local.size());
    case Number::length: case Number::affine_offset: return m;
    case Number::affine: return m * n;
    case Number::end: return 6 * springs.count();
    case Number::stiffness: case Number::rest_length: case Number::damping: return springs.count();
    case Number::written: return written ? written->parameters() : 0;
    default: return n;
  }
}

void Core::vary(Number what, In numbers) {
  const int k = static_cast<int>(what);
  const auto from = [k](Number first) { return k - static_cast<int>(first); };
  if (what == Number::written)
    written->vary(numbers);
  else if (what >= Number::end)
    springs.vary(static_cast<Springs::Number>(from(Number::end)), numbers);
  else if (what >= Number::point)
    rows.vary(static_cast<Rows::Number>(from(Number::point)), numbers);
  else
    tree.vary(static_cast<Tree::Number>(k), numbers);
  here_ = 0, basis_at_ = -1, ++sets;
}

bool Core::reversed() {
  if (rows.closure.rows != static_cast<int>(z.size()) || z.empty()) return false;
  Matrix square(z.size(), z.size());
  jacobian();
  for (size_t k = 0; k < z.size(); ++k) square.col(k) = rows.J.col(z[k]);
  return square.partialPivLu().determinant() < 0.0;
}

void Core::set(In q_tree_, bool with_inertia) {
  ++sets;
  q_tree = q_tree_;
  Profile::Entry entry(profile, with_inertia && !written ? Profile::D_tree : Profile::phi);
  if (written) {
    written->place(q_tree, rows.phi, rows.J);
    here_ = jacobian_of_rows;
    return;
  }
  if (with_inertia)
    tree.inertia(q_tree);
  else
    tree.set(q_tree);
  here_ = (with_inertia ? inertia_of_tree : 0u) | tree_is_set;
  rows.set(tree, q_tree);
}

void Core::set_velocity(In v) {
  if (v_tree == v) return;
  v_tree = v;
  here_ &= ~(row_rates | bias_of_tree | coriolis_of_tree);
}

// For what is not written out.
void Core::set_tree() {
  if (has(tree_is_set)) return;
  tree.set(q_tree);
  rows.set(tree, q_tree);
  here_ |= tree_is_set;
}

void Core::jacobian() {
  if (has(jacobian_of_rows)) return;
  Profile::Entry entry(profile, Profile::J);
  rows.jacobian(tree);
  here_ |= jacobian_of_rows;
}

void Core::factor() {
  if (has(factor_of_phi_z)) return;
  jacobian();
  Profile::Entry entry(profile, Profile::phi_z);
  phi_z.compute(rows.J, z);
  here_ |= factor_of_phi_z;
}

void Core::reduce() {
  if (has(rho_of_phi_z)) return;
  factor();
  Profile::Entry entry(profile, Profile::rho);
  for (int k = 0; k < d; ++k) {
    residual_ = -rows.J.col(q[k]);
    phi_z.solve(residual_, z_);
    for (int i = 0; i < d; ++i) rho(q[i], k) = 0.0;
    rho(q[k], k) = 1.0;
    for (size_t i = 0; i < z.size(); ++i) rho(z[i], k) = z_(i);
  }
  here_ |= rho_of_phi_z;
}

void Core::tree_inertia() {
  if (has(inertia_of_tree)) return;
  Profile::Entry entry(profile, Profile::D_tree);
  if (written)
    written->inertia(q_tree, D_written_);
  else
    tree.inertia(q_tree);
  here_ |= inertia_of_tree;
}

void Core::inertia() {
  if (has(inertia_of_q)) return;
  tree_inertia(), reduce();
  Profile::Entry entry(profile, Profile::D);
  if (dense_) {
    D_rho_.noalias() = D_tree().selfadjointView<Eigen::Upper>() * rho;
    D.noalias() = rho.transpose() * D_rho_;
  } else {
    for (int k = 0; k < d; ++k) D_times(rho.col(k), D_rho_.col(k));
    for (int i = 0; i < d; ++i)
      for (int k = 0; k < d; ++k) D(i, k) = rho.col(i).dot(D_rho_.col(k));
  }
  D_factor.compute(D);
  here_ |= inertia_of_q;
}

void Core::D_times(In x, Out product) const {
  const Matrix& D = D_tree();
  product.setZero();
  for (int j = 0; j < n; ++j) {
    double sum = 0.0;
    for (int i : tree.ancestors[j]) {
      if (i == j) continue;
      product(i) += D(i, j) * x(j);
      sum += D(i, j) * x(i);
    }
    product(j) += sum + D(j, j) * x(j);
  }
}

double Core::potential_energy() {
  if (written) return written->potential_energy(q_tree);
  spring_lengths();
  return tree.potential_energy(q_tree) + springs.energy(tree, q_tree);
}

Energy Core::energy(In v, Out momentum) {
  tree_inertia();
  D_times(v, momentum);
  return {0.5 * v.dot(momentum), potential_energy()};
}

void Core::velocity(In q_dot, Out v) const {
  v.setZero();
  for (int k = 0; k < d; ++k) v += q_dot(k) * rho.col(k);
}

void Core::reduced(In force, Out generalized) const {
  for (int k = 0; k < d; ++k) generalized(k) = rho.col(k).dot(force);
}

// The tree's velocities, and from them the rows'.
void Core::row_rates_of_tree() {
  if (has(row_rates)) return;
  set_tree();
  bias_without_springs_ = tree.bias(q_tree, v_tree);
  rows.rates(tree);
  here_ |= row_rates;
}

void Core::jacobian_rate(In v) {
  if (written) return written->jacobian_rate(q_tree, v, rows.J_dot);
  set_velocity(v);
  row_rates_of_tree();
  rows.jacobian_dot(tree, tree.jacobian_rate(q_tree, v_tree));
}

// A step x beside v' does not commute with it where axes turn along.
void Core::closure_rate(In v, Matrix& by_q) {
  jacobian_rate(v);
  by_q = rows.J_dot;
  if (!tree.roots.empty()) jacobian(), by_q.noalias() -= rows.J * tree.brackets(v);
}

void Core::bias() {
  if (has(bias_of_tree)) return;
  Profile::Entry entry(profile, Profile::bias_tree);
  here_ |= bias_of_tree;
  if (written) return written->bias(q_tree, v_tree, bias_tree, J_dot_v, damping_tree);
  row_rates_of_tree();
  rows.bias(J_dot_v);
  bias_tree = bias_without_springs_;
  if (springs.any) spring_forces(), bias_tree -= elastic_;
  if (!springs.any_damping) return;
  spring_lengths(), damping_tree.setZero();
  springs.add_damping(v_tree, damping_tree);
}

void Core::spring_forces() {
  spring_lengths(), elastic_.setZero();
  springs.add_elastic(tree, q_tree, elastic_);
}

void Core::spring_lengths() {
  if (has(lengths_of_springs)) return;
  set_tree();
  if (springs.any || springs.any_damping) springs.set(tree);
  here_ |= lengths_of_springs;
}

void Core::coriolis() {
  if (has(coriolis_of_tree)) return;
  Profile::Entry entry(profile, Profile::C_tree);
  here_ |= coriolis_of_tree;
  if (written && written->has_coriolis()) {
    jacobian_rate(v_tree);
    return written->rest(q_tree, h_tree);
  }
  row_rates_of_tree();
  C_tree_ = tree.coriolis(q_tree, v_tree);
  rows.jacobian_dot(tree, tree.jacobian_dot());
  h_tree = tree.gravity(q_tree);
  if (springs.any) spring_forces(), h_tree -= elastic_;
}

void Core::C_tree_times(In x, Out product) {
  if (written && written->has_coriolis())
    written->coriolis(q_tree, v_tree, x, product);
  else
    product.noalias() = C_tree_ * x;
}

void Core::rho_dot_times(In x, Out product) {
  velocity(x, moved_);
  residual_.noalias() = -rows.J_dot * moved_;
  phi_z.solve(residual_, z_);
  product.setZero();
  for (size_t i = 0; i < z.size(); ++i) product(z[i]) = z_(i);
}

void Core::C_times(In x, Out product) {
  rho_dot_times(x, x_);
  D_times(x_, y_);
  velocity(x, x_);
  C_tree_times(x_, moved_);
  y_ += moved_;
  reduced(y_, product);
}

void Core::reduced_acceleration(In u_tree, Out q_ddot) {
  inertia(), bias();
  residual_ = -J_dot_v;
  phi_z.solve(residual_, z_);  // J rho = 0 differentiated
  rho_dot_q_dot_.setZero();
  for (size_t i = 0; i < z.size(); ++i) rho_dot_q_dot_(z[i]) = z_(i);
  D_times(rho_dot_q_dot_, y_);
  x_ = u_tree - bias_tree - y_ + damping_tree;
  reduced(x_, d_);
  D_factor.solve(d_, q_ddot);
}

void Core::tree_acceleration(In q_ddot, Out a) const {
  a = rho_dot_q_dot_;
  for (int k = 0; k < d; ++k) a += q_ddot(k) * rho.col(k);
}

void Core::actual_acceleration(In u_tree, In q_dot, Out q_ddot) {
  inertia(), bias(), coriolis();
  C_times(q_dot, d_);
  x_ = u_tree - h_tree + damping_tree;
  for (int k = 0; k < d; ++k) d_(k) = rho.col(k).dot(x_) - d_(k);
  D_factor.solve(d_, q_ddot);
}

void Core::spf_z_dot(In q_dot, double epsilon, In w, Out z_dot) {
  phi_z.solve(w, z_dot);
  for (size_t i = 0; i < z.size(); ++i) z_dot(i) = rho.row(z[i]).dot(q_dot) - z_dot(i) / epsilon;
}

}  // namespace ckc
