#include "system.hpp"

namespace ckc {

System::System(Core& core_, int size_) : core(core_), size(size_), drive(core_.d, core_.n) {
  velocity.setZero(core.n), v_tree.setZero(core.n), w.setZero(core.rows.closure.rows);
  q.setZero(core.d), q_dot.setZero(core.d);
}

}  // namespace ckc
