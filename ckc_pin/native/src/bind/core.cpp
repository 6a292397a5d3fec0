// Bindings of a mechanism's terms.
#include <limits>

#include <nanobind/stl/unique_ptr.h>

#include "bind/checks.hpp"
#include "loops/core.hpp"
#include "loops/compiled_terms.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

void require_partition(const Core& core, const Indices& q, const Indices& z) {
  require_indices(q, core.n, "q"), require_indices(z, core.n, "z");
  std::vector<bool> is_listed(core.n, false);
  for (const auto& part : {q, z})
    for (int k : part) {
      require(!is_listed[k], "partition: a coordinate is named twice");
      is_listed[k] = true;
    }
  require(static_cast<int>(q.size() + z.size()) == core.n, "partition: a coordinate is missing");
  require(static_cast<int>(z.size()) <= core.constraints.closure.rows,
          "partition: more dependent coordinates than rows");
}

std::vector<Vector3> triples(const Matrix& table, const char* what) {
  require(table.cols() == 3 && table.allFinite(), std::string(what) + ": three finite columns are needed");
  std::vector<Vector3> list;
  for (Eigen::Index k = 0; k < table.rows(); ++k) list.push_back(table.row(k).transpose());
  return list;
}

Matrix3 matrix3(const Matrix& rows, Eigen::Index k) {
  Matrix3 m;
  for (int i = 0; i < 3; ++i) m.row(i) = rows.row(k).segment<3>(3 * i);
  return m;
}

}  // namespace

Closure closure_from_table(const nb::dict& table) {
  Closure c;
  c.rows = get<int>(table, "rows");
  c.point_joint = get<Indices>(table, "point_joint");
  c.point_local = triples(get<Matrix>(table, "point_local"), "point_local");
  c.direction_joint = get<Indices>(table, "direction_joint");
  c.direction_local = triples(get<Matrix>(table, "direction_local"), "direction_local");
  for (const auto& row : get<std::vector<Indices>>(table, "component"))
    c.components.push_back({row[0], row[1], row[2]});
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
  const auto breaks = get<Matrix>(table, "curve_breaks"), origins = get<Matrix>(table, "curve_origins"),
             polynomials = get<Matrix>(table, "curve_coefficients");
  for (const auto& row : get<std::vector<Indices>>(table, "curve")) {
    const auto k = static_cast<Eigen::Index>(c.curves.size());
    const Vector flat = polynomials.row(k).transpose();  // the coefficients of one piece after those of the other
    c.curves.push_back({row[0], row[1], breaks.row(k).transpose(), origins.row(k).transpose(),
                        flat.reshaped(flat.size() / origins.cols(), origins.cols())});
  }
  const auto a = get<Matrix>(table, "rotation_a"), b = get<Matrix>(table, "rotation_b");
  for (const auto& row : get<std::vector<Indices>>(table, "log")) {
    const auto k = static_cast<Eigen::Index>(c.logs.size());
    c.logs.push_back({{row[0], row[1], row[2]}, row[3], row[4], matrix3(a, k), matrix3(b, k)});
  }
  return c;
}

SpringTable springs_from_table(const nb::dict& table) {
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

namespace {

JointTable joints_from_table(const nb::dict& table) {
  return {get<Vector>(table, "friction"),    get<Vector>(table, "lower"), get<Vector>(table, "upper"),
          get<Vector>(table, "restitution"), get<Vector>(table, "reach"), get<double>(table, "size"),
          get<double>(table, "smoothing")};
}

}  // namespace

std::unique_ptr<CompiledTerms> compiled_terms_from(const nb::tuple& library) {
  return std::make_unique<CompiledTerms>(nb::cast<std::string>(library[0]), nb::cast<Vector>(library[1]));
}

std::unique_ptr<Core> core_from_table(const nb::dict& table) {
  auto core = std::make_unique<Core>(CoreTable{
      model_from_table(table),
      get<Indices>(table, "q_index"),
      closure_from_table(get<nb::dict>(table, "closure")),
      springs_from_table(get<nb::dict>(table, "springs")),
      joints_from_table(get<nb::dict>(table, "joints")),
      get<Vector>(table, "rotors"),
      get<int>(table, "rank"),
      get<Indices>(table, "independent_rows"),
      {get<Vector>(table, "row_scale"), get<Vector>(table, "column_scale"), get<double>(table, "rank_tolerance")},
      table.contains("compiled") ? compiled_terms_from(get<nb::tuple>(table, "compiled")) : nullptr,
  });
  require(core->scales.rows, core->constraints.closure.rows, "row_scale");
  require(core->scales.columns, core->n, "column_scale");
  const auto q = get<Indices>(table, "q"), z = get<Indices>(table, "z");
  require_partition(*core, q, z);
  core->set_partition(q, z);
  return core;
}

namespace {

// Return all terms at one state, for comparisons.
nb::typed<nb::dict, nb::str, Matrix> terms(Core& core, VectorArg q_tree, VectorArg v_tree) {
  require(q_tree, core.tree.nq, "q_tree"), require(v_tree, core.n, "v_tree");
  core.set_configuration(q_tree), core.compute_D(), core.set_velocity(v_tree), core.compute_bias(),
      core.compute_coriolis();
  nb::typed<nb::dict, nb::str, Matrix> by_name;
  for (const char* name : {"phi", "J", "rho", "D_tree", "D", "bias_tree", "C_tree", "h_tree", "C", "rho_dot", "h"})
    by_name[name] = term_by_name(core, name);
  by_name["J_dot_v"] = core.J_dot_v, by_name["J_dot"] = core.constraints.J_dot;
  return by_name;
}

Matrix jacobian(Core& core, VectorArg q_tree) {
  require(q_tree, core.tree.nq, "q_tree");
  core.set_configuration(q_tree), core.compute_J();
  return core.constraints.J();
}

Vector reduced_acceleration(Core& core, VectorArg q_tree, VectorArg q_dot, VectorArg v_tree, VectorArg u_tree,
                            bool actual) {
  require(q_tree, core.tree.nq, "q_tree"), require(q_dot, core.d, "q_dot");
  require(v_tree, core.n, "v_tree"), require(u_tree, core.n, "u_tree");
  Vector q_ddot(core.d);
  core.set_configuration(q_tree), core.set_velocity(v_tree);
  if (actual)
    core.actual_acceleration(u_tree, q_dot, q_ddot);
  else
    core.reduced_acceleration(u_tree, q_ddot);
  return q_ddot;
}

Vector dae_acceleration(Core& core, VectorArg q_tree, VectorArg v_tree, VectorArg u_tree, VectorArg correction) {
  require(q_tree, core.tree.nq, "q_tree"), require(v_tree, core.n, "v_tree");
  require(u_tree, core.n, "u_tree"), require(correction, core.constraints.closure.rows, "correction");
  Vector acceleration(core.n);
  core.set_configuration(q_tree, true), core.set_velocity(v_tree);
  if (!core.dae_acceleration(u_tree, correction, acceleration))
    acceleration.setConstant(std::numeric_limits<double>::quiet_NaN());
  return acceleration;
}

}  // namespace

nb::object term_by_name(Core& core, const std::string& name) {
  if (name == "at") return nb::none();
  if (name == "phi") return nb::cast(core.constraints.phi);
  if (name == "J") return core.compute_J(), nb::cast(core.constraints.J());
  if (name == "rho") return core.compute_rho(), nb::cast(core.rho);
  if (name == "D") return core.compute_D(), nb::cast(core.D);
  if (name == "bias_tree") return core.compute_bias(), nb::cast(core.bias_tree);
  if (name == "potential_energy") return nb::cast(core.potential_energy());
  if (name == "D_tree") {
    core.compute_D_tree();
    Matrix D_tree(core.n, core.n);
    for (int k = 0; k < core.n; ++k) core.multiply_D_tree(Vector::Unit(core.n, k), D_tree.col(k));
    return nb::cast(D_tree);
  }
  core.compute_rho(), core.compute_D_tree(), core.compute_coriolis();
  if (name == "C_tree") {
    Matrix C_tree(core.n, core.n);
    for (int k = 0; k < core.n; ++k) core.multiply_C_tree(Vector::Unit(core.n, k), C_tree.col(k));
    return nb::cast(C_tree);
  }
  if (name == "h_tree") return nb::cast(core.h_tree);
  Vector x(core.d);
  if (name == "h") return core.multiply_rho_transposed(core.h_tree, x), nb::cast(x);
  Matrix of_q(core.d, core.d), of_tree(core.n, core.d);
  for (int k = 0; k < core.d; ++k) {
    x = Vector::Unit(core.d, k);
    if (name == "C")
      core.multiply_C(x, of_q.col(k));
    else
      core.multiply_rho_dot(x, of_tree.col(k));
  }
  if (name == "C") return nb::cast(of_q);
  require(name == "rho_dot", "term: no " + name);
  return nb::cast(of_tree);
}

void bind_core(nb::module_& m) {
  nb::class_<Core>(m, "Core", "The terms of a mechanism at one state.")
      .def(nb::new_([](const nb::typed<nb::dict, nb::str, nb::any>& table) { return core_from_table(table); }),
           "table"_a)
      .def(
          "set_partition",
          [](Core& core, const Indices& q, const Indices& z) {
            require_partition(core, q, z);
            core.set_partition(q, z);
          },
          "q"_a, "z"_a)
      .def("jacobian", &jacobian, "q_tree"_a, "Return J.")
      .def("terms", &terms, "q_tree"_a, "v_tree"_a, "Return the terms of eqs. 1 and 6 at a state, by name.")
      .def("reduced_acceleration", &reduced_acceleration, "q_tree"_a, "q_dot"_a, "v_tree"_a, "u_tree"_a, "actual"_a,
           "Return q_ddot of eq. 6, with C at v' = rho q_dot or, if `actual`, at v_tree.")
      .def("dae_acceleration", &dae_acceleration, "q_tree"_a, "v_tree"_a, "u_tree"_a, "correction"_a,
           "Return the acceleration of eq. 1, NaN if J has lost rank; `correction` is added to J_dot v'.")
      .def("allow_elimination", &Core::allow_elimination, "allowed"_a,
           "Compute accelerations by elimination without pivoting, if there is one, or always by projection.")
      .def_prop_ro("has_elimination", &Core::has_elimination,
                   "Whether accelerations are computed by elimination without pivoting: by compiled terms, articulated bodies or "
                   "sparse matrices.");
}

}  // namespace ckc
