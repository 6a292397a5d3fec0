// What a capable user of Pinocchio would write: constraintDynamics or lcaba under Boost.Odeint's Runge-Kutta-Fehlberg
// 7(8) with its own step control. Reads one problem from standard input, writes the motion at its instants and its cost.
#include <pinocchio/algorithm/energy.hpp>
#include <pinocchio/algorithm/jacobian.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/loop-constrained-aba.hpp>
#include <pinocchio/algorithm/proximal.hpp>
#include <pinocchio/constraints.hpp>
#include <pinocchio/multibody.hpp>

#include <boost/numeric/odeint/integrate/integrate_times.hpp>
#include <boost/numeric/odeint/stepper/generation.hpp>
#include <boost/numeric/odeint/stepper/runge_kutta_fehlberg78.hpp>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <iostream>
#include <stdexcept>

// constraintDynamics is declared here, because its header takes a compiler half a minute. The library contains it.
namespace pinocchio {
template <typename Scalar, int Options, template <typename, int> class Collection, class Constraint, class Allocator,
          class ConstraintData, class DataAllocator>
void initConstraintDynamics(const ModelTpl<Scalar, Options, Collection>&, DataTpl<Scalar, Options, Collection>&,
                            const std::vector<Constraint, Allocator>&,
                            const std::vector<ConstraintData, DataAllocator>&);
template <typename Scalar, int Options, template <typename, int> class Collection, typename Q, typename V, typename Tau,
          class Allocator, class DataAllocator>
const typename DataTpl<Scalar, Options, Collection>::TangentVectorType& constraintDynamics(
    const ModelTpl<Scalar, Options, Collection>&, DataTpl<Scalar, Options, Collection>&, const Eigen::MatrixBase<Q>&,
    const Eigen::MatrixBase<V>&, const Eigen::MatrixBase<Tau>&,
    const std::vector<RigidConstraintModelTpl<Scalar, Options>, Allocator>&,
    std::vector<RigidConstraintDataTpl<Scalar, Options>, DataAllocator>&, ProximalSettingsTpl<Scalar>&);
}  // namespace pinocchio

namespace pin = pinocchio;
namespace odeint = boost::numeric::odeint;

using State = std::vector<double>;  // q of the model, then v
using Clock = std::chrono::steady_clock;
using Vector = Eigen::VectorXd;

constexpr double enough = 0.05;  // s of repeats, and three at least: short runs are repeated more often
constexpr double brief = 0.5;    // s of repeats after which there is no other one

template <class T>
T read() {
  T x;
  if (!(std::cin >> x)) throw std::runtime_error("the problem ends early");
  return x;
}

Vector read_vector(Eigen::Index n) {
  Vector x(n);
  for (double& number : x) number = read<double>();
  return x;
}

pin::SE3 read_placement() {
  const Vector x = read_vector(12);
  return {Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(x.data()), x.tail<3>()};
}

pin::JointModel read_joint() {
  const auto kind = read<std::string>();
  if (kind == "free") return pin::JointModelFreeFlyer();
  const Eigen::Vector3d axis = read_vector(3);
  const bool turns = kind == "turns";
  if (axis == Eigen::Vector3d::UnitX()) return turns ? pin::JointModel(pin::JointModelRX()) : pin::JointModelPX();
  if (axis == Eigen::Vector3d::UnitY()) return turns ? pin::JointModel(pin::JointModelRY()) : pin::JointModelPY();
  if (axis == Eigen::Vector3d::UnitZ()) return turns ? pin::JointModel(pin::JointModelRZ()) : pin::JointModelPZ();
  if (turns) return pin::JointModelRevoluteUnaligned(axis);
  return pin::JointModelPrismaticUnaligned(axis);
}

pin::Model read_model() {
  pin::Model model;
  model.gravity.linear() = read_vector(3);
  for (auto remaining = read<int>(); remaining > 0; --remaining) {
    const auto parent = read<pin::JointIndex>();
    const pin::SE3 placement = read_placement();
    const auto joint = model.addJoint(parent, read_joint(), placement, std::to_string(remaining));
    const auto mass = read<double>();
    const Eigen::Vector3d center = read_vector(3);
    const Vector moments = read_vector(9);
    const pin::Inertia inertia(mass, center, Eigen::Map<const Eigen::Matrix3d>(moments.data()));
    model.appendBodyToJoint(joint, inertia, pin::SE3::Identity());
  }
  model.armature = read_vector(model.nv);
  return model;
}

struct Spring {  // between two points of bodies
  int joint[2];
  Eigen::Vector3d local[2];
  double stiffness, rest_length, damping;
};

struct Problem {
  pin::Model model;
  pin::Data data;
  std::vector<pin::RigidConstraintModel> constraints;
  std::vector<pin::RigidConstraintData> constraint_data;
  bool by_lcaba;
  pin::ProximalSettings proximal;
  std::vector<Spring> springs;
  Vector stiffness, rest, damping, constant;  // on joints
  Vector q, v, tau;
  double tolerance;
  State start, instants;
  std::size_t rhs = 0;

  Problem() : model(read_model()), data(model) {
    by_lcaba = read<std::string>() == "lcaba";
    const double gain = read<double>();
    for (auto remaining = read<int>(); remaining > 0; --remaining) {
      const auto type = read<int>() == 6 ? pin::CONTACT_6D : pin::CONTACT_3D;
      auto a = read<pin::JointIndex>();
      pin::SE3 on_a = read_placement();
      auto b = read<pin::JointIndex>();
      pin::SE3 on_b = read_placement();
      if (a == 0) std::swap(a, b), std::swap(on_a, on_b);  // lcaba takes the world as the second body only
      constraints.emplace_back(type, model, a, on_a, b, on_b, pin::LOCAL);
      constraints.back().m_baumgarte_parameters.Kp = gain;
      constraints.back().m_baumgarte_parameters.Kd = 2 * std::sqrt(gain);
      constraint_data.push_back(constraints.back().createData());
    }
    if (by_lcaba)
      pin::computeJointMinimalOrdering(model, data, constraints);
    else
      pin::initConstraintDynamics(model, data, constraints, constraint_data);
    const auto accuracy = read<double>(), mu = read<double>();
    proximal = pin::ProximalSettings(accuracy, mu, read<int>());
    for (auto remaining = read<int>(); remaining > 0; --remaining) {
      Spring s;
      for (int end : {0, 1}) s.joint[end] = read<int>(), s.local[end] = read_vector(3);
      s.stiffness = read<double>(), s.rest_length = read<double>(), s.damping = read<double>();
      springs.push_back(s);
    }
    for (Vector* on_joints : {&stiffness, &rest, &damping, &constant}) *on_joints = read_vector(model.nv);
    tolerance = read<double>();
    const Vector at = read_vector(model.nq + model.nv);
    start.assign(at.begin(), at.end());
    const Vector times = read_vector(read<int>());
    instants.assign(times.begin(), times.end());
    q.setZero(model.nq), v.setZero(model.nv), tau.setZero(model.nv);
  }

  void operator()(const State& x, State& rate, double) {
    ++rhs;
    std::copy_n(x.begin(), model.nq, q.begin());
    std::copy_n(x.begin() + model.nq, model.nv, v.begin());
    configuration_rate(rate);
    const Vector& a = acceleration();
    std::copy(a.begin(), a.end(), rate.begin() + model.nq);
  }

  const Vector& acceleration() {
    tau = constant - damping.cwiseProduct(v);
    if (model.nq == model.nv) tau -= stiffness.cwiseProduct(q - rest);
    if (!springs.empty()) pull();
    if (by_lcaba && constraints.size() && constraints[0].m_baumgarte_parameters.Kp > 0) update_errors_of_points();
    if (by_lcaba) clear_accelerations_of_welds();
    if (by_lcaba) return pin::lcaba(model, data, q, v, tau, constraints, constraint_data, proximal);
    return pin::constraintDynamics(model, data, q, v, tau, constraints, constraint_data, proximal);
  }

 private:
  // q_dot is v but for free roots, of whose quaternion the length, a matter of rounding, is taken off
  void configuration_rate(State& rate) {
    if (model.nq == model.nv) {
      std::copy(v.begin(), v.end(), rate.begin());
      return;
    }
    for (int joint = 1; joint < model.njoints; ++joint) {
      const int at = model.idx_qs[joint], v_at = model.idx_vs[joint];
      if (model.nqs[joint] != 7) {
        rate[at] = v[v_at];
        continue;
      }
      q.segment<4>(at + 3).normalize();
      const Eigen::Quaterniond turned(q.segment<4>(at + 3));
      const Eigen::Vector3d w = v.segment<3>(v_at + 3);
      const Eigen::Vector3d p_dot = turned * v.segment<3>(v_at);
      const Eigen::Quaterniond twice = turned * Eigen::Quaterniond(0, w.x(), w.y(), w.z());
      for (int k : {0, 1, 2}) rate[at + k] = p_dot[k];
      for (int k : {0, 1, 2, 3}) rate[at + 3 + k] = 0.5 * twice.coeffs()[k];
    }
  }

  // lcaba of Pinocchio 4.1 adds the accelerations that the call before left to the desired ones of 6D constraints.
  void clear_accelerations_of_welds() {
    for (const auto& constraint : constraints)
      if (constraint.type == pin::CONTACT_6D)
        data.oa[constraint.joint1_id].setZero(), data.oa[constraint.joint2_id].setZero();
  }

  // lcaba of Pinocchio 4.1 reads the errors of point constraints for its Baumgarte terms, but does not compute them.
  void update_errors_of_points() {
    pin::forwardKinematics(model, data, q, v);
    for (std::size_t k = 0; k < constraints.size(); ++k) {
      const auto& constraint = constraints[k];
      if (constraint.type != pin::CONTACT_3D) continue;
      const auto a = constraint.joint1_id, b = constraint.joint2_id;
      const pin::SE3 on_a = constraint.joint1_placement, on_b = constraint.joint2_placement;
      const pin::SE3 b_in_a = (data.oMi[a] * on_a).actInv(data.oMi[b] * on_b);
      constraint_data[k].contact_placement_error.linear() = -b_in_a.translation();
      constraint_data[k].contact_velocity_error.linear() =
          on_a.actInv(data.v[a]).linear() - b_in_a.rotation() * on_b.actInv(data.v[b]).linear();
    }
  }

  void pull() {
    pin::computeJointJacobians(model, data, q);
    for (const Spring& s : springs) {
      const Eigen::Vector3d p[] = {data.oMi[s.joint[0]].act(s.local[0]), data.oMi[s.joint[1]].act(s.local[1])};
      const Eigen::Vector3d r = p[0] - p[1];
      const double length = r.norm();
      if (length == 0) continue;
      pin::Force unit[2];
      for (int end : {0, 1}) unit[end] = pin::Force(r / length, p[end].cross(r / length));
      double speed = 0;
      for_each_column(s, [&](int k, double of_length) { speed += of_length * v[k]; }, unit);
      const double force = s.stiffness * (length - s.rest_length) + s.damping * speed;
      for_each_column(s, [&](int k, double of_length) { tau[k] -= force * of_length; }, unit);
    }
  }

  template <class Use>
  void for_each_column(const Spring& s, Use use, const pin::Force (&unit)[2]) {
    for (int end : {0, 1})
      for (int joint = s.joint[end]; joint > 0; joint = static_cast<int>(model.parents[joint]))
        for (int k = model.idx_vs[joint]; k < model.idx_vs[joint] + model.nvs[joint]; ++k)
          use(k, (end ? -1 : 1) * unit[end].toVector().dot(data.J.col(k)));
  }
};

void write(const char* name, const double* first, Eigen::Index many) {
  std::printf("%s", name);
  for (Eigen::Index k = 0; k < many; ++k) std::printf(" %.17g", first[k]);
  std::printf("\n");
}

// What the start is compared by before anything is timed: D', the bias, the energy without springs, the acceleration.
void check(Problem& problem) {
  State rate(problem.start.size());
  problem(problem.start, rate, 0.0);
  const pin::Model& model = problem.model;
  pin::Data data(model);  // of constraintDynamics, which leaves D' and the bias there
  pin::initConstraintDynamics(model, data, problem.constraints, problem.constraint_data);
  pin::constraintDynamics(model, data, problem.q, problem.v, problem.tau, problem.constraints, problem.constraint_data,
                          problem.proximal);
  const Eigen::MatrixXd D = data.M.selfadjointView<Eigen::Upper>();
  write("D", D.data(), D.size());
  write("bias", data.nle.data(), model.nv);
  const double energy = pin::computeMechanicalEnergy(model, data, problem.q, problem.v);
  write("energy", &energy, 1);
  write("acceleration", rate.data() + model.nq, model.nv);
}

// The shortest time of an acceleration at the start, without the step control around it.
void time_acceleration(Problem& problem) {
  constexpr int batches = 5, calls = 200;
  double shortest = 1e30;
  for (int batch = 0; batch < batches; ++batch) {
    const auto began = Clock::now();
    for (int call = 0; call < calls; ++call) problem.acceleration();
    shortest = std::min(shortest, std::chrono::duration<double>(Clock::now() - began).count() / calls);
  }
  write("acceleration_s", &shortest, 1);
}

void run(Problem& problem) {
  using Stepper = odeint::runge_kutta_fehlberg78<State>;
  std::vector<State> states;
  std::vector<double> walls;
  std::size_t steps = 0;
  double spent = 0;
  do {  // the first one warms up, and counts where it is long
    State x = problem.start;
    states.clear(), states.reserve(problem.instants.size()), problem.rhs = 0;
    const auto began = Clock::now();
    steps = odeint::integrate_times(
        odeint::make_controlled<Stepper>(problem.tolerance, problem.tolerance), std::ref(problem), x,
        problem.instants.begin(), problem.instants.end(), problem.instants[1] / 10,
        [&](const State& at, double) { states.push_back(at); });
    walls.push_back(std::chrono::duration<double>(Clock::now() - began).count());
    spent += walls.back();
  } while (spent < brief && (walls.size() < 4 || spent < enough));
  const double told[] = {*std::min_element(walls.begin(), walls.end()), double(steps), double(problem.rhs)};
  write("cost", told, 3);
  for (const State& state : states) write("state", state.data(), static_cast<Eigen::Index>(state.size()));
}

int main() try {
  Problem problem;
  check(problem);
  problem.instants.empty() ? time_acceleration(problem) : run(problem);
} catch (const std::exception& error) {
  std::fprintf(stderr, "%s\n", error.what());
  return 1;
}
