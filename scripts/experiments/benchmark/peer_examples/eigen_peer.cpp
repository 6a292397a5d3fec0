// A program for the benchmark: Eigen under Boost.Odeint. docs/report/peers.md explains the protocol, and how to compile.
#include <boost/numeric/odeint.hpp>

#include "problem.hpp"

namespace odeint = boost::numeric::odeint;
using V3 = Eigen::Vector3d;
using M3 = Eigen::Matrix3d;
using V6 = Eigen::Matrix<double, 6, 1>;  // angular part, then linear part at the world's origin
using M6 = Eigen::Matrix<double, 6, 6>;
using Matrix = Eigen::MatrixXd;

M3 cross(const V3& a) { return (M3() << 0, -a.z(), a.y(), a.z(), 0, -a.x(), -a.y(), a.x(), 0).finished(); }
M6 motion_cross(const V6& v) {
  const M3 w = cross(V3(v.head<3>()));
  return (M6() << w, M3::Zero(), cross(V3(v.tail<3>())), w).finished();
}

struct Link {  // A is the acceleration without v_dot, relative to free fall
  M3 R;
  V3 p;
  V6 V, A;
  Eigen::Matrix<double, 6, Eigen::Dynamic> J;
};

struct RightHandSide {
  const Problem& problem;
  std::size_t& count;

  void operator()(const State& x, State& rate, double) const {
    const int n = x.size() / 2;
    const Vector q = Vector::Map(x.data(), n), v = Vector::Map(x.data() + n, n);
    V6 base = V6::Zero();
    base.tail<3>() = -problem.gravity;
    std::vector<Link> links{{M3::Identity(), V3::Zero(), V6::Zero(), base, Matrix::Zero(6, n)}};
    Matrix M = problem.armature.asDiagonal();
    Vector tau = problem.force - problem.stiffness.cwiseProduct(q - problem.rest) - problem.damping.cwiseProduct(v);
    for (int k = 0; k < n; ++k) {
      const Body& b = problem.bodies[k];
      const bool turns = b.joint == "revolute";
      Link link = links[b.parent];
      link.p += link.R * b.p, link.R *= b.R;
      const V3 s = link.R * b.axis;
      const V6 S = turns ? (V6() << s, link.p.cross(s)).finished() : (V6() << V3::Zero(), s).finished();
      link.J.col(k) = S, link.A += motion_cross(link.V) * S * v[k], link.V += S * v[k];
      if (turns) link.R *= Eigen::AngleAxisd(q[k], b.axis).toRotationMatrix();
      else link.p += s * q[k];
      const M3 c = cross(V3(link.p + link.R * b.center)), mass = b.mass * M3::Identity();
      const M3 about_origin = link.R * b.inertia * link.R.transpose() + mass * c * c.transpose();
      const M6 inertia = (M6() << about_origin, mass * c, mass * c.transpose(), mass).finished();
      M += link.J.transpose() * inertia * link.J;
      tau -= link.J.transpose() * (inertia * link.A - motion_cross(link.V).transpose() * (inertia * link.V));
      links.push_back(link);
    }
    Matrix J = Matrix::Zero(3 * problem.pairs.size(), n);  // of p_a - p_b
    Vector target = Vector::Zero(J.rows());  // J v_dot; it also closes a loop that rounding has opened
    for (std::size_t k = 0; k < problem.pairs.size(); ++k)
      for (int end : {0, 1}) {
        const auto& [body, local] = problem.pairs[k][end];
        const Link& link = links[body];
        const V3 p = link.p + link.R * local, w = link.V.head<3>(), alpha = link.A.head<3>();
        const V3 speed = link.V.tail<3>() + w.cross(p), a = link.A.tail<3>() + alpha.cross(p) + w.cross(speed);
        const double sign = end ? -1 : 1;
        target.segment<3>(3 * k) -= sign * (a + 20 * speed + 100 * p);
        J.middleRows<3>(3 * k) += sign * (link.J.bottomRows<3>() - cross(p) * link.J.topRows<3>());
      }
    const Eigen::LLT<Matrix> factor(M);
    const Matrix X = factor.solve(J.transpose());
    const Vector free = factor.solve(tau);
    Eigen::CompleteOrthogonalDecomposition<Matrix> mobility;  // finds the rank: rows may be redundant
    mobility.setThreshold(1e-10);
    const Vector a = free + X * mobility.compute(J * X).solve(target - J * free);
    std::copy(v.begin(), v.end(), rate.begin()), std::copy(a.begin(), a.end(), rate.begin() + n), ++count;
  }
};

int main() {
  Problem problem = read_problem(std::cin);
  std::cout.precision(17);
  std::cout << R"({"name": "Eigen with Boost.Odeint", "version": "1"})" << std::endl;
  for (const Body& body : problem.bodies)
    if (body.joint == "free") problem.unsupported = "it has no free bodies";
  if (!problem.json.get_child("springs").empty()) problem.unsupported = "it has no springs between bodies";
  if (!problem.unsupported.empty()) return std::cout << "{\"unsupported\": \"" << problem.unsupported << "\"}\n", 0;
  std::size_t count = 0, n = problem.bodies.size();
  const RightHandSide f{problem, count};
  State rate(2 * n);
  f(problem.start, rate, 0), std::cout << "{", print("acceleration", rate.data() + n, n), std::cout << "}" << std::endl;
  auto integrate = [&] {
    State x = problem.start;
    std::vector<State> states;
    auto stepper = odeint::make_controlled<odeint::runge_kutta_fehlberg78<State>>(problem.rtol, problem.rtol);
    count = 0;
    odeint::integrate_times(stepper, std::ref(f), x, problem.instants, problem.instants[1] / 10,
                            [&](const State& state, double) { states.push_back(state); });
    return states;
  };
  if (!problem.instants.empty()) print_motion(problem, integrate, count, n);
}
