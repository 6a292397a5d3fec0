// Records the state at the output instants of a run, one row each.
#pragma once

#include <string>

#include "motion/system.hpp"

namespace ckc {

// Where a quantity is in a row of the record: columns from begin to end.
struct RecordColumns {
  std::string name;
  Eigen::Index begin, end;
};

class Recorder {
 public:
  explicit Recorder(const System& system);

  const std::vector<RecordColumns> columns;
  const Eigen::Index width;  // columns of a row

  void start(Vector instants, double* rows, Eigen::Index max_rows);  // rows: (max_rows, width)
  bool is_due(double t) const { return next_ < instants_.size() && instants_(next_) <= t && filled < max_rows_; }
  double next_instant() const { return instants_(next_); }
  bool is_full() const { return filled == max_rows_; }
  // Record the state at (t, y) unless that instant is already recorded. False if the state cannot be evaluated.
  bool add(System& system, double t, In y);
  void advance_instant() { ++next_; }
  // Remove the last row if its time is t, so that another state can be recorded there.
  void drop_row_at(double t) { filled -= filled && rows_[(filled - 1) * width] >= t; }

  Eigen::Index filled = 0;  // recorded rows

 private:
  bool fill_row(System& system, double t, In y, Out row);

  Vector instants_, momentum_, phi_dot_;
  double* rows_ = nullptr;
  Eigen::Index max_rows_ = 0, next_ = 0;
};

}  // namespace ckc
