// A mechanism from Python's tables, and its terms.
#include <limits>

#include "checks.hpp"
#include "core.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

void require_partition(const Core& core, const Indices& q, const Indices& z) {
  require_indices(q, core.n, "q"), require_indices(z, core.n, "z");
  std::vector<bool> met(core.n, false);
  for (const auto& part : {q, z})
    for (int k : part) {
      require(!met[k], "partition: a coordinate is named twice");
      met[k] = true;
    }
  require(static_cast<int>(q.size() + z.size()) == core.n, "partition: a coordinate is missing");
  require(static_cast<int>(z.size()) <= core.rows.closure.rows, "partition: more dependent coordinates than rows");
}

std::vector<Vector3> triples(const Matrix& table, const char* what) {
  require(table.cols() == 3 && table.allFinite(), std::string(what) + ": three finite columns are needed");
  std::vector<Vector3> list;
  for (Eigen::Index k = 0; k < table.rows(); ++k) list.push_back(table.row(k).transpose());
  return list;
}

template <class T>
T get(const nb::dict& table, const char* key) {
  require(table.contains(key), std::string("table: no key ") + key);
  return nb::cast<T>(table[key]);
}

Matrix3 matrix3(const Matrix& rows, Eigen::Index k) {
  Matrix3 m;
  for (int i = 0; i < 3; ++i) m.row(i) = rows.row(k).segment<3>(3 * i);
  return m;
}

Closure closure_of(const nb::dict& table) {
  Closure c;
  c.rows = get<int>(table, "rows");
  c.point_joint = get<Indices>(table, "point_joint");
  c.point_local = triples(get<Matrix>(table, "point_local"), "point_local");
  c.direction_joint = get<Indices>(table, "direction_joint");
  c.direction_local = triples(get<Matrix>(table, "direction_local"), "direction_local");
  for (const auto& row : get<std::vector<Indices>>(table, "component")) c.components.push_back({row[0], row[1], row[2]});
  for (const auto& row : get<std::vector<Indices>>(table, "dot")) c.dots.push_back({row[0], row[1], row[2]});
  const auto lengths = get<Vector>(table, "length");
  for (const auto& row : get<std::vector<Indices>>(table, "distance"))
    c.distances.push_back({row[0], row[1], lengths(c.distances.size())});
  const auto matrix = get<Matrix>(table, "affine_matrix");
  const auto offsets = get<Vector>(table, "affine_offset");
  for (int out : get<Indices>(table, "affine")) {
    const auto k = static_cast<Eigen::Index>(c.affine.size());
    c.affine.push_back({out, matrix.row(k).transpose(), offsets(k)});
  }
  const auto a = get<Matrix>(table, "rotation_a"), b = get<Matrix>(table, "rotation_b");
  for (const auto& row : get<std::vector<Indices>>(table, "log")) {
    const auto k = static_cast<Eigen::Index>(c.logs.size());
    c.logs.push_back({{row[0], row[1], row[2]}, row[3], row[4], matrix3(a, k), matrix3(b, k)});
  }
  return c;
}

SpringTable springs_of(const nb::dict& table) {
  SpringTable s;
  s.point_joint = get<Indices>(table, "point_joint");
  s.point_local = triples(get<Matrix>(table, "point_local"), "point_local");
  s.stiffness = get<Vector>(table, "stiffness");
  s.rest_length = get<Vector>(table, "rest_length");
  s.damping = get<Vector>(table, "damping");
  s.joint_stiffness = get<Vector>(table, "joint_stiffness");
  s.joint_rest = get<Vector>(table, "joint_rest");
  s.joint_damping = get<Vector>(table, "joint_damping");
  s.constant = get<Vector>(table, "constant");
  return s;
}

// Everything at one state, for comparison.
nb::dict terms(Core& core, Given q_tree, Given v_tree) {
  require(q_tree, core.tree.nq, "q_tree"), require(v_tree, core.n, "v_tree");
  core.set(q_tree), core.factor(), core.reduce(), core.inertia(), core.bias(v_tree);
  nb::dict found;
  found["phi"] = core.rows.phi, found["J"] = core.rows.J, found["rho"] = core.rho, found["D"] = core.D;
  found["bias_tree"] = core.bias_tree, found["J_dot_v"] = core.J_dot_v;
  Matrix D_tree(core.n, core.n), C(core.d, core.d), rho_dot = Matrix::Zero(core.n, core.d);
  for (int k = 0; k < core.n; ++k) core.D_times(Vector::Unit(core.n, k), D_tree.col(k));
  found["D_tree"] = D_tree;
  core.coriolis();
  found["C_tree"] = core.C_tree, found["h_tree"] = core.h_tree, found["J_dot"] = core.rows.J_dot;
  Vector h(core.d), z(core.z.size());
  for (int k = 0; k < core.d; ++k) {
    core.C_times(Vector::Unit(core.d, k), C.col(k));
    core.solve_z(-core.rows.J_dot * core.rho.col(k), z);
    for (size_t i = 0; i < core.z.size(); ++i) rho_dot(core.z[i], k) = z(i);
  }
  core.reduced(core.h_tree, h);
  found["C"] = C, found["rho_dot"] = rho_dot, found["h"] = h;
  return found;
}

Vector phi(Core& core, Given q_tree) {
  require(q_tree, core.tree.nq, "q_tree");
  core.set(q_tree);
  return core.rows.phi;
}

Matrix jacobian(Core& core, Given q_tree) {
  require(q_tree, core.tree.nq, "q_tree");
  core.set(q_tree), core.rows.jacobian(core.tree);
  return core.rows.J;
}

nb::tuple jacobians(Core& core, Given q_tree, Given v_tree) {
  require(q_tree, core.tree.nq, "q_tree"), require(v_tree, core.n, "v_tree");
  core.set(q_tree), core.rows.jacobian(core.tree), core.bias(v_tree);
  core.rows.jacobian_dot(core.tree, core.tree.jacobian_rate(q_tree, v_tree));
  return nb::make_tuple(core.rows.J, core.rows.J_dot);
}

Vector reduced_acceleration(Core& core, Given q_tree, Given q_dot, Given v_tree, Given u_tree, bool actual) {
  require(q_tree, core.tree.nq, "q_tree"), require(q_dot, core.d, "q_dot");
  require(v_tree, core.n, "v_tree"), require(u_tree, core.n, "u_tree");
  Vector q_ddot(core.d);
  core.set(q_tree), core.factor(), core.reduce(), core.inertia();
  core.bias(v_tree);
  if (actual) {
    core.coriolis();
    core.actual_acceleration(u_tree, q_dot, q_ddot);
  } else {
    core.reduced_acceleration(u_tree, q_ddot);
  }
  return q_ddot;
}

Vector dae_acceleration(Core& core, Given q_tree, Given v_tree, Given u_tree, Given correction) {
  require(q_tree, core.tree.nq, "q_tree"), require(v_tree, core.n, "v_tree");
  require(u_tree, core.n, "u_tree"), require(correction, core.rows.closure.rows, "correction");
  Vector acceleration(core.n);
  core.set(q_tree, true), core.rows.jacobian(core.tree), core.bias(v_tree);
  if (!core.dae_acceleration(u_tree, correction, acceleration))
    acceleration.setConstant(std::numeric_limits<double>::quiet_NaN());
  return acceleration;
}

}  // namespace

void bind_core(nb::module_& m) {
  nb::class_<Core>(m, "Core")
      .def("__init__",
           [](Core* self, const std::string& model, const Indices& place, const nb::dict& closure,
              const nb::dict& springs, int rank, const Indices& q, const Indices& z) {
             new (self) Core(model, place, closure_of(closure), springs_of(springs), rank);
             require_partition(*self, q, z);
             self->split(q, z);
           },
           "model"_a, "place"_a, "closure"_a, "springs"_a, "rank"_a, "q"_a, "z"_a)
      .def("split",
           [](Core& core, const Indices& q, const Indices& z) {
             require_partition(core, q, z);
             core.split(q, z);
           },
           "q"_a, "z"_a)
      .def("phi", &phi, "q_tree"_a)
      .def("jacobian", &jacobian, "q_tree"_a)
      .def("jacobians", &jacobians, "q_tree"_a, "v_tree"_a)  // J and J_dot
      .def("terms", &terms, "q_tree"_a, "v_tree"_a)
      .def("reduced_acceleration", &reduced_acceleration, "q_tree"_a, "q_dot"_a, "v_tree"_a, "u_tree"_a, "actual"_a)
      .def("dae_acceleration", &dae_acceleration, "q_tree"_a, "v_tree"_a, "u_tree"_a, "correction"_a);
}

}  // namespace ckc
