// A formulation together with how its motion changes with parameters, y = (its y, and by parameter the change of q', v').
#pragma once

#include <algorithm>
#include <type_traits>

#include "motion/dae.hpp"
#include "motion/level_set.hpp"
#include "sensitivity/sensitivities.hpp"

namespace ckc {

class WithVariation {
 public:
  virtual ~WithVariation() = default;
  virtual Variation& variation() = 0;
  virtual Matrix changes(In y) const = 0;  // (2 n, parameters)
  std::optional<Apart> apart;  // why the motion has no derivative from here on
  double impact_at = std::numeric_limits<double>::quiet_NaN();  // s, the last one: rates jumped when it came
};

template <class Base>
class Varied : public Base, public WithVariation {
 public:
  template <class... Given>
  Varied(VariationTable table, Given&&... given)
      : Base(std::forward<Given>(given)...),
        size_(Base::size),
        of_start_(std::all_of(table.parameters.begin(), table.parameters.end(),
                              [](const Parameter& of) { return of.effects.empty(); })),
        variation_(*this, std::move(table)) {
    this->size = size_ + 2 * variation_.n * variation_.count;
    this->crosses = false;
  }

  Variation& variation() override { return variation_; }
  Matrix changes(In y) const override { return Eigen::Map<const Matrix>(y.data() + size_, rows(), variation_.count); }

  void start(double t, In q_tree, In v, In w, Out y) override {
    Base::start(t, q_tree, v, w, y.head(size_));
    apart.reset(), impact_at = std::numeric_limits<double>::quiet_NaN();
    this->core.set(q_tree);
    if (!variation_.start(v, s_)) s_.setConstant(2 * variation_.n, variation_.count, std::nan(""));
    put(y);
  }

  bool rhs(double t, In y, Out y_dot) override {
    if (!Base::rhs(t, y.head(size_), y_dot.head(size_))) return false;
    Eigen::Map<Matrix> s_dot(y_dot.data() + size_, rows(), variation_.count);
    if (written_rates(y, s_dot) && finite(y_dot.tail(this->size - size_))) return true;
    take(y);
    if (!rates(t, y, y_dot)) {
      const Control& control = this->control;
      if (variation_.at_pole()) return this->fails(Trouble::pole);
      return this->fails(control.clipped.any && control.redundant() ? Trouble::shares : Trouble::infinite);
    }
    s_dot = s_dot_;
    return true;
  }

  bool exact(double t, In y) override { return Base::exact(t, y.head(size_)); }
  bool at_start(double t, In y) override { return Base::at_start(t, y.head(size_)); }
  bool at_last(double t, In y) override { return Base::at_last(t, y.head(size_)); }
  bool place(In y) override { return Base::place(y.head(size_)); }
  Accepted accept(double t, Out y, double margin) override {
    variation_.accept();
    if (this->core.joints.any()) variation_.measure(Eigen::Map<const Matrix>(y.data() + size_, rows(), variation_.count));
    return Base::accept(t, y.head(size_), margin);
  }
  bool own_partition(double t, Out y, bool& changed) override { return Base::own_partition(t, y.head(size_), changed); }
  bool modes(In y, Matrix& jacobian) override { return Base::modes(y.head(size_), jacobian); }
  bool tree_acceleration(In f, Out a) const override { return Base::tree_acceleration(f.head(size_), a); }
  void whole(In f, Out x, Out x_dot) const override { Base::whole(f.head(size_), x, x_dot); }
  int beside() const override { return this->size - size_; }
  void push(Out y, In v) const override { Base::push(y.head(size_), v); }
  void shift(Out y, In step) const override { Base::shift(y.head(size_), step); }
  void go_on(double t, Out y) override { Base::go_on(t, y.head(size_)); }

  // Of the motion; how the changes' own rates change along it, an iteration can do without.
  bool jacobian(double t, In y, Matrix& jacobian, long& evaluations) override {
    const long differences = this->counts.differences;
    if (!Base::jacobian(t, y.head(size_), jacobian, evaluations)) return false;
    const bool of_dae = std::is_same_v<Base, Dae>, known = this->counts.differences == differences;
    if (of_dae && !known) Base::at_last(t, y.head(size_));
    v_ = !of_dae ? this->v_tree : known ? Vector(y.segment(this->core.tree.nq, variation_.n)) : this->velocity;
    if (!known && !this->slopes(Vector(this->core.q_tree), v_, this->uncorrected_, this->by_q_, this->by_v_)) return false;
    const int n = variation_.n;
    block_.setZero(2 * n, 2 * n), block_.topRightCorner(n, n).setIdentity();
    if (!this->core.tree.roots.empty()) block_.topLeftCorner(n, n) = -this->core.tree.brackets(v_);
    block_.bottomLeftCorner(n, n) = this->by_q_, block_.bottomRightCorner(n, n) = this->by_v_;
    return block_.allFinite();
  }
  bool moves(double t, In y, Out y_dot) override { return Base::rhs(t, y, y_dot); }
  const Matrix* beside_jacobian() const override { return &block_; }
  void beside_rates(std::vector<std::pair<int, int>>& of) const override {
    of.clear();
    for (int k : this->core.tree.single) of.emplace_back(k, variation_.n + k);
  }

  bool before_change(double t, In y, const std::vector<System::Met>& met) override {
    take(y), a_.resize(variation_.n), v_ = this->velocity, changes_at_ = t;
    return this->acceleration(t, a_) && variation_.before_change(v_, a_, met, s_);
  }
  bool at_impact(In step, const Indices& at, const Matrix& responses, In x, double restitution) override {
    impact_at = changes_at_;
    if (!variation_.at_impact(v_, step, at, responses, x, restitution, s_)) return false;
    v_ += step;
    return true;
  }
  bool after_change(double t, Out y, const std::vector<System::Met>& arrived, double rtol, double atol) override {
    if (!this->acceleration(t, a_) || !variation_.project_sensitivities(this->velocity, s_)) return false;
    if ((apart = variation_.apart(arrived, s_, rtol, atol))) return false;
    variation_.after_change(this->velocity, a_, s_);
    put(y);
    return true;
  }
  bool stays_locked(double atol) override { return !(apart = variation_.let_go(atol)); }
  bool sampled(In y, bool& changed) override {
    if (!this->control.sampling->holds) return true;
    take(y);
    return variation_.sampled(s_, *this->control.sampling, changed) || this->fails(Trouble::infinite);
  }
  int extra() const override { return (rows() + this->core.d + static_cast<int>(this->control.tau.size())) * variation_.count; }
  void put_extra(In y, Out row) override {
    take(y);
    variation_.efforts(this->velocity, s_, u_, tau_);
    double* place = row.data();
    for (const Matrix* x : {&s_, &u_, &tau_}) place = std::copy(x->data(), x->data() + x->size(), place);
  }

 private:
  int rows() const { return 2 * variation_.n; }
  void take(In y) { s_ = Eigen::Map<const Matrix>(y.data() + size_, rows(), variation_.count); }
  // Where the right-hand side was evaluated last, by the code that is written out.
  bool written_rates(In y, Eigen::Ref<Matrix> s_dot) {
    if (!variation_.is_written()) return false;
    const Eigen::Map<const Matrix> s(y.data() + size_, rows(), variation_.count);
    if constexpr (std::is_same_v<Base, Dae>) {
      return variation_.written_rates(this->q_tree_, y.segment(this->q_tree_.size(), variation_.n), s, s_dot);
    } else {
      return variation_.written_rates(this->core.q_tree, this->v_tree, s, s_dot);
    }
  }
  bool rates(double t, In y, In y_dot) {
    if (std::is_same_v<Base, Dae>) Base::at_last(t, y.head(size_));
    v_ = std::is_same_v<Base, Dae> ? this->velocity : this->v_tree;
    a_.resize(variation_.n);
    if (!Base::tree_acceleration(y_dot.head(size_), a_)) return false;
    if (!of_start_ || !this->core.written || variation_.holds()) return variation_.rates(v_, a_, s_, s_dot_);
    this->core.set_velocity(v_);
    if (!this->slopes(Vector(this->core.q_tree), v_, this->uncorrected_, this->by_q_, this->by_v_)) return false;
    variation_.rates_of_start(v_, this->by_q_, this->by_v_, s_, s_dot_);
    return true;
  }
  void put(Out y) const { Eigen::Map<Matrix>(y.data() + size_, rows(), variation_.count) = s_; }

  const int size_;  // of the base's y
  const bool of_start_;  // nothing varies but where it starts
  Variation variation_;
  Matrix s_, s_dot_, block_, u_, tau_;
  Vector v_, a_;
  double changes_at_ = 0.0;  // s: when joints do
};

}  // namespace ckc
