// The extension module.
#include "bind/checks.hpp"
#include "motion/system.hpp"

NB_MODULE(_core, m) {
  nanobind::set_leak_warnings(false);  // a traceback may keep a loop alive until the interpreter exits
  m.attr("pinocchio_version") = ckc::pinocchio_version();
  m.attr("chart_margin") = ckc::chart_margin;
  ckc::bind_core(m);
  ckc::bind_loop(m);
  ckc::bind_gate(m);
  ckc::bind_batch(m);
  ckc::bind_linearization(m);
  ckc::bind_many(m);
  ckc::bind_speed_profile(m);
}
