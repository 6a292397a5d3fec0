#include "tree/tree.hpp"

#include <pinocchio/algorithm/energy.hpp>
#include <pinocchio/algorithm/jacobian.hpp>
#include <pinocchio/algorithm/rnea-derivatives.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/multibody.hpp>
#include <pinocchio/serialization.hpp>
#include <pinocchio/spatial.hpp>

#include <algorithm>
#include <cmath>

#include "tree/rigid_body.hpp"
#include "tree/rotation.hpp"

namespace ckc {

namespace pin = pinocchio;

// A workspace with the members that the algorithms of this file use. Pinocchio's own has tensors of 40 n^3 bytes for second
// derivatives, which nothing here computes.
static pin::Data make_data(const pin::Model& model) {
  pin::Data data;
  const Eigen::Index n = model.nv;
  const size_t joints = model.njoints;
  for (const auto& joint : model.joints) data.joints.push_back(joint.createData());
  for (auto* motions : {&data.v, &data.ov, &data.a, &data.oa, &data.a_gf, &data.oa_gf})
    motions->assign(joints, pin::Motion::Zero());
  for (auto* forces : {&data.f, &data.of, &data.h, &data.oh}) forces->assign(joints, pin::Force::Zero());
  for (auto* placements : {&data.oMi, &data.liMi}) placements->assign(joints, pin::SE3::Identity());
  for (auto* inertias : {&data.Ycrb, &data.oYcrb, &data.oinertias}) inertias->assign(joints, pin::Inertia::Zero());
  for (auto* matrices : {&data.vxI, &data.Ivx, &data.B, &data.doYcrb}) matrices->assign(joints, Matrix6::Zero());
  for (auto* points : {&data.com, &data.vcom, &data.acom}) points->assign(joints, Vector3::Zero());
  for (auto* columns : {&data.J, &data.dJ, &data.Ag, &data.dAg, &data.dVdq, &data.dAdq, &data.dAdv, &data.dFdq, &data.dFdv,
                        &data.dFda})
    columns->setZero(6, n);
  for (auto* vector : {&data.tau, &data.nle, &data.g}) vector->setZero(n);
  data.Fcrb.assign(1, pin::Data::Matrix6x::Zero(6, n));  // the only one that is used
  data.mass.assign(joints, -1.0);
  data.a_gf[0] = -model.gravity;
  data.nvSubtree.assign(joints, 0), data.parents_fromRow.assign(n, -1);
  for (size_t joint = joints - 1; joint > 0; --joint) {
    const size_t parent = model.parents[joint];
    data.nvSubtree[joint] += model.nvs[joint], data.nvSubtree[parent] += data.nvSubtree[joint];
    for (int k = 1; k < model.nvs[joint]; ++k) data.parents_fromRow[model.idx_vs[joint] + k] = model.idx_vs[joint] + k - 1;
    if (parent) data.parents_fromRow[model.idx_vs[joint]] = model.idx_vs[parent] + model.nvs[parent] - 1;
  }
  return data;
}

struct Tree::Workspace {
  pin::Model model;
  pin::Data data;
  std::vector<RigidBody> composites;  // by joint: all bodies that it moves, as one
  Matrix6x axes;                      // the Jacobian at the reference point of `composites`
  std::vector<double> D_entries;
  explicit Workspace(pin::Model&& loaded)
      : model(std::move(loaded)), data(make_data(model)), composites(model.njoints) {}
};

static pin::Model load_model(const std::string& serialized) {
  pin::Model model;
  boost::asio::streambuf buffer;
  buffer.sputn(serialized.data(), static_cast<std::streamsize>(serialized.size()));
  pin::serialization::loadFromBinary(model, buffer);
  return model;
}

Tree::Tree(const std::string& serialized, Indices q_index_) : q_index(std::move(q_index_)) {
  workspace_ = std::make_unique<Workspace>(load_model(serialized));
  const pin::Model& model = workspace_->model;
  n = model.nv, nq = model.nq, joints = model.njoints;
  support.resize(joints);
  ancestors.resize(n), joint_of.resize(n), parent.assign(model.parents.begin(), model.parents.end());
  for (int joint = 1; joint < joints; ++joint) {
    if (model.nqs[joint] == 7)
      roots.push_back({model.idx_qs[joint], model.idx_vs[joint]});
    else
      single_dof.push_back(model.idx_vs[joint]);
    support[joint] = support[model.parents[joint]];
    for (int k = model.idx_vs[joint]; k < model.idx_vs[joint] + model.nvs[joint]; ++k) {
      support[joint].push_back(k);
      joint_of[k] = joint;
      ancestors[k] = support[joint];
    }
  }
  set_inertia_pattern(ancestors);
}

void Tree::set_inertia_pattern(std::vector<Indices> pattern) {
  inertia_pattern = std::move(pattern), D_diagonal.resize(n);
  int entries = 0;
  for (int j = 0; j < n; ++j) entries += static_cast<int>(inertia_pattern[j].size()), D_diagonal[j] = entries - 1;
}

Tree::~Tree() = default;

void Tree::set_parameters(Parameter parameter, In values) {
  pin::Model& model = workspace_->model;
  const auto vector_of = [&](int joint) { return Vector3(values.segment<3>(3 * joint)); };
  if (parameter == Parameter::gravity) model.gravity.linear() = vector_of(0);
  if (parameter == Parameter::armature) model.armature = values;
  if (parameter == Parameter::rotors) set_rotors(values);
  for (int joint = 0; joint < joints; ++joint) {
    pin::Inertia& body = model.inertias[joint];
    if (parameter == Parameter::offset) model.jointPlacements[joint].translation() = vector_of(joint);
    if (parameter == Parameter::mass) body.mass() = values(joint);
    if (parameter == Parameter::centre) body.lever() = vector_of(joint);
    if (parameter == Parameter::inertia)
      body.inertia() = pin::Symmetric3(Matrix3(Eigen::Map<const Matrix3>(values.data() + 9 * joint)));
  }
}

void Tree::set_rotors(In values) {
  rotors_.setZero(n, n);
  std::vector<Indices> pattern = ancestors;
  for (int j = 0; j < n; ++j)
    for (int i = 0; i <= j; ++i) {
      rotors_(i, j) = rotors_(j, i) = values(n * i + j);
      if (rotors_(i, j) == 0.0) continue;
      if (!std::binary_search(ancestors[j].begin(), ancestors[j].end(), i)) pattern[j].push_back(i);
    }
  for (Indices& rows : pattern) std::sort(rows.begin(), rows.end());
  set_inertia_pattern(std::move(pattern));
}

void Tree::set_configuration(In q) { pin::computeJointJacobians(workspace_->model, workspace_->data, q); }

const Matrix6x& Tree::jacobian() const { return workspace_->data.J; }

Matrix3 Tree::rotation(int joint) const { return workspace_->data.oMi[joint].rotation(); }

Vector3 Tree::translation(int joint) const { return workspace_->data.oMi[joint].translation(); }

// The composite rigid body algorithm in world axes. Pinocchio's writes a matrix, whose entries are far apart in memory.
// The reference point is on the mechanism: far from it, sums of moments lose digits.
void Tree::compute_D(In q) {
  set_configuration(q);
  auto& [model, data, composites, axes, entries] = *workspace_;
  const Vector3 reference = translation(joints > 1 ? 1 : 0);
  for (int joint = 1; joint < joints; ++joint) {
    const Body in_world = body(joint);
    composites[joint] = rigid_body(in_world.mass, in_world.centre - reference, in_world.inertia);
  }
  for (int joint = joints - 1; joint > 0; --joint)
    if (parent[joint]) add(composites[joint], composites[parent[joint]]);
  axes.resize(6, n), entries.clear();
  for (int j = 0; j < n; ++j) {
    const Vector3 omega = data.J.col(j).tail<3>();
    axes.col(j) << data.J.col(j).head<3>() + omega.cross(reference), omega;
  }
  for (int j = 0; j < n; ++j) {
    const RigidBody& composite = composites[joint_of[j]];
    const Vector3 velocity = axes.col(j).head<3>(), omega = axes.col(j).tail<3>();
    Vector6 force;
    force << momentum(composite, velocity, omega), angular_momentum(composite, velocity, omega);
    auto ancestor = ancestors[j].begin();
    for (int i : inertia_pattern[j]) {
      double entry = rotors_.size() ? rotors_(i, j) : 0.0;
      if (ancestor != ancestors[j].end() && *ancestor == i) entry += axes.col(i).dot(force), ++ancestor;
      entries.push_back(i == j ? entry + model.armature(j) : entry);
    }
  }
}

const std::vector<double>& Tree::D_entries() const { return workspace_->D_entries; }

const Vector& Tree::compute_bias(In q, In v) {
  return pin::nonLinearEffects(workspace_->model, workspace_->data, q, v);
}

Vector6 Tree::velocity(int joint) const {
  return workspace_->data.oMi[joint].act(workspace_->data.v[joint]).toVector();
}

Vector6 Tree::bias_acceleration(int joint) const {
  // nonLinearEffects represents gravity by an upward acceleration of the world. Remove it.
  return workspace_->data.oMi[joint].act(workspace_->data.a_gf[joint]).toVector() +
         workspace_->model.gravity.toVector();
}

const Vector& Tree::compute_gravity(In q) {
  return pin::computeGeneralizedGravity(workspace_->model, workspace_->data, q);
}

const Matrix& Tree::compute_coriolis(In q, In v) {
  if (!workspace_->data.C.size()) workspace_->data.C.setZero(n, n);
  return pin::computeCoriolisMatrix(workspace_->model, workspace_->data, q, v);
}

const Matrix6x& Tree::jacobian_dot() const { return workspace_->data.dJ; }

const Matrix6x& Tree::compute_jacobian_dot(In q, In v) {
  return pin::computeJointJacobiansTimeVariation(workspace_->model, workspace_->data, q, v);
}

double Tree::potential_energy(In q) { return pin::computePotentialEnergy(workspace_->model, workspace_->data, q); }

void Tree::compute_derivatives(In q, In v, In a, bool gravity, Matrix& by_q, Matrix& by_v) {
  pin::Model& model = workspace_->model;
  pin::Data& data = workspace_->data;
  if (!data.M.size()) data.M.setZero(n, n), data.dtau_dq.setZero(n, n), data.dtau_dv.setZero(n, n);
  pin::computeRNEADerivatives(model, data, q, v, a);
  by_q = data.dtau_dq, by_v = data.dtau_dv;
  if (gravity) return;  // placements, motions and Jacobian are those at this state
  Matrix of_gravity = Matrix::Zero(n, n);
  pin::computeGeneralizedGravityDerivatives(model, data, q, of_gravity);
  by_q -= of_gravity;
  pin::forwardKinematics(model, data, q, v, a);
  set_configuration(q);
}

Vector6 Tree::acceleration(int joint) const {
  return workspace_->data.oMi[joint].act(workspace_->data.a[joint]).toVector();
}

Matrix6 Tree::spatial_inertia(int joint) const {
  return joint ? workspace_->data.oMi[joint].act(workspace_->model.inertias[joint]).matrix() : Matrix6(Matrix6::Zero());
}

Tree::Body Tree::body(int joint) const {
  const pin::Inertia body = workspace_->data.oMi[joint].act(workspace_->model.inertias[joint]);
  return {body.mass(), body.lever(), body.inertia().matrix()};
}

Matrix Tree::rotor_inertia() const {
  Matrix inertia = rotors_.size() ? rotors_ : Matrix::Zero(n, n);
  inertia.diagonal() += workspace_->model.armature;
  return inertia;
}

const Vector& Tree::armature() const { return workspace_->model.armature; }

Vector6 Tree::spatial_gravity() const { return workspace_->model.gravity.toVector(); }

static Eigen::Quaterniond orientation_of(In q, Tree::Root root) {
  return Eigen::Quaterniond(Eigen::Vector4d(q.segment<4>(root.q + 3))).normalized();
}

static pin::SE3 placement(In q, Tree::Root root) {
  return {orientation_of(q, root).toRotationMatrix(), q.segment<3>(root.q)};
}

void Tree::normalize(Out q) const {
  for (const Root& root : roots) q.segment<4>(root.q + 3).normalize();
}

void Tree::integrate(Out q, In step) const {
  for (int k : single_dof) q(q_index[k]) += step(k);
  for (const Root& root : roots) {
    const pin::SE3 next_placement = placement(q, root) * pin::exp6(pin::Motion(step.segment<6>(root.v)));
    Eigen::Quaterniond orientation(next_placement.rotation());
    orientation.normalize();
    // Of the two quaternions of this rotation, take the one closer to the previous.
    if (orientation.dot(orientation_of(q, root)) < 0) orientation.coeffs() *= -1;
    q.segment<3>(root.q) = next_placement.translation();
    q.segment<4>(root.q + 3) = orientation.coeffs();
  }
}

void Tree::difference(In from, In to, Out step) const {
  for (int k : single_dof) step(k) = to(q_index[k]) - from(q_index[k]);
  for (const Root& root : roots)
    step.segment<6>(root.v) = pin::log6(placement(from, root).actInv(placement(to, root))).toVector();
}

void Tree::difference_rate(In from, In to, In v, Out rate) const {
  rate = v;
  for (const Root& root : roots)
    rate.segment<6>(root.v) = pin::Jlog6(placement(from, root).actInv(placement(to, root))) * v.segment<6>(root.v);
}

void Tree::configuration_rate(In q, In v, Out q_dot) const {
  for (int k : single_dof) q_dot(q_index[k]) = v(k);
  for (const Root& root : roots) {
    const Eigen::Quaterniond orientation = orientation_of(q, root);
    Eigen::Quaterniond spin;  // half the angular velocity in the body's axes
    spin.w() = 0.0, spin.vec() = 0.5 * v.segment<3>(root.v + 3);
    q_dot.segment<3>(root.q) = orientation * Vector3(v.segment<3>(root.v));
    q_dot.segment<4>(root.q + 3) = (orientation * spin).coeffs();
  }
}

// As in `ckc_pin.mechanism.tree`.
double Tree::tolerance_scale(In q, In units) const {
  double largest = 0.0;
  for (int k : single_dof) largest = std::max(largest, std::abs(q(q_index[k])) / units(k));
  for (const Root& root : roots)
    largest = std::max(largest, q.segment<3>(root.q).lpNorm<Eigen::Infinity>() / units(root.v));
  return tolerance_factor(largest);
}

double Tree::tolerance_factor(double largest_coordinate) {
  constexpr double large_coordinate = 100.0, max_factor = 1e4;
  return std::clamp(largest_coordinate / large_coordinate, 1.0, max_factor);
}

Matrix Tree::q_dot_to_tangent(In q) const {
  Matrix matrix = Matrix::Zero(n, nq);
  for (int k : single_dof) matrix(k, q_index[k]) = 1.0;
  for (const Root& root : roots) {
    const Eigen::Quaterniond orientation = orientation_of(q, root);
    const double size = q.segment<4>(root.q + 3).norm();
    matrix.block<3, 3>(root.v, root.q) = orientation.toRotationMatrix().transpose();
    for (int k = 0; k < 4; ++k) {  // twice the vector part of conj(orientation) times the change
      Eigen::Quaterniond change(0, 0, 0, 0);
      change.coeffs()(k) = 1.0;
      matrix.block<3, 1>(root.v + 3, root.q + 3 + k) = 2.0 / size * (orientation.conjugate() * change).vec();
    }
  }
  return matrix;
}

Matrix Tree::configuration_rate_derivative(In q, In v) const {
  Matrix matrix = Matrix::Zero(nq, n);
  for (const Root& root : roots) {
    const Eigen::Quaterniond orientation = orientation_of(q, root);
    Eigen::Quaterniond half, spin;
    spin.w() = 0.0, spin.vec() = 0.5 * v.segment<3>(root.v + 3);
    for (int k = 0; k < 3; ++k) {
      half.w() = 0.0, half.vec() = 0.5 * Vector3::Unit(k);
      matrix.block<3, 1>(root.q, root.v + 3 + k) =
          orientation * Vector3(Vector3::Unit(k).cross(Vector3(v.segment<3>(root.v))));
      matrix.block<4, 1>(root.q + 3, root.v + 3 + k) = (orientation * half * spin).coeffs();
    }
  }
  return matrix;
}

void Tree::add_bracket(In v, In x, Out sum) const {
  for (const Root& root : roots) {
    const Vector3 v_linear = v.segment<3>(root.v), v_angular = v.segment<3>(root.v + 3);
    const Vector3 x_linear = x.segment<3>(root.v), x_angular = x.segment<3>(root.v + 3);
    sum.segment<3>(root.v) += v_angular.cross(x_linear) + v_linear.cross(x_angular);
    sum.segment<3>(root.v + 3) += v_angular.cross(x_angular);
  }
}

Matrix Tree::bracket_matrix(In v) const {
  Matrix matrix = Matrix::Zero(n, n);
  for (const Root& root : roots)
    for (int k = root.v; k < root.v + 6; ++k) add_bracket(v, Vector::Unit(n, k), matrix.col(k));
  return matrix;
}

Matrix3 Tree::orientation(In q, Root root) const { return orientation_of(q, root).toRotationMatrix(); }

Vector6 Tree::twist_to(In q, Root root, const Matrix3& orientation, const Vector3& position) const {
  return pin::log6(placement(q, root).actInv(pin::SE3(orientation, position))).toVector();
}

void Tree::to_coordinates(In q, Out coordinates) const {
  for (int k : single_dof) coordinates(k) = q(q_index[k]);
  for (const Root& root : roots) {
    coordinates.segment<3>(root.v) = q.segment<3>(root.q);
    coordinates.segment<3>(root.v + 3) = pin::log3(orientation_of(q, root).toRotationMatrix());
  }
}

double Tree::coordinate_change(In q, int k, In step) const {
  for (const Root& root : roots) {
    if (k < root.v || k >= root.v + 6) continue;
    const Matrix3 orientation = orientation_of(q, root).toRotationMatrix();
    const int row = k - root.v;
    return row < 3 ? orientation.row(row).dot(step.segment<3>(root.v))
                   : Jlog3(orientation).row(row - 3).dot(step.segment<3>(root.v + 3));
  }
  return step(k);
}

Vector3 log3(const Matrix3& rotation) { return pin::log3(rotation); }

Matrix3 exp3(const Vector3& vector) { return pin::exp3(vector); }

Matrix3 Jlog3(const Matrix3& rotation) {
  Matrix3 j;
  pin::Jlog3(rotation, j);
  return j;
}

std::string pinocchio_version() { return PINOCCHIO_VERSION; }

}  // namespace ckc
