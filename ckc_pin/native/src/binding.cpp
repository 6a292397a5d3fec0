// The module that Python imports.
#include "checks.hpp"
#include "tree.hpp"

NB_MODULE(_core, m) {
  m.attr("pinocchio_version") = ckc::pinocchio_version();
  ckc::bind_core(m);
  ckc::bind_systems(m);
  ckc::bind_loop(m);
}
