// The module that Python imports.
#include "bind/checks.hpp"
#include "motion/system.hpp"

NB_MODULE(_core, m) {
  nanobind::set_leak_warnings(false);  // a traceback that Python keeps to its end keeps its loop
  m.attr("pinocchio_version") = ckc::pinocchio_version();
  m.attr("chart_margin") = ckc::chart_margin;
  ckc::bind_core(m);
  ckc::bind_loop(m);
  ckc::bind_gate(m);
  ckc::bind_batch(m);
  ckc::bind_plant(m);
}
