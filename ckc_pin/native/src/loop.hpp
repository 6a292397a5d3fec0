// The step loop: plain steps one after the other, and leaps over positions where J loses rank. Whatever else there is
// to a run is Python's, between two calls.
#pragma once

#include <chrono>

#include "crossing.hpp"
#include "record.hpp"

namespace ckc {

enum class Why {
  finished,  // t_bound is reached
  pause,     // time is up, or the rows are full
  python,    // the next step, or what follows it, is not plain
};

struct Stretch {
  double t_bound, min_step;
  long most_rhs;       // evaluations left
  double seconds;      // from now, to the next pause
  double last_output;  // instants up to there
  bool fine;           // whether the tolerance is one that crossings come out well with
};

class Loop {
 public:
  Loop(System& system, Method& method, Watch& watch, Crossing& crossing, Record& record)
      : system_(system), method_(method), watch_(watch), crossing_(crossing), record_(record), y_out_(method.y) {}

  // Record the instants `times` from `due` on into rows, as many as there are.
  Why run(const Stretch& stretch, In times, Eigen::Index& due, Eigen::Ref<Matrix> rows, Eigen::Index& filled);

  long steps = 0;
  Watch::Rank end;     // at the end of the last step
  bool begun = false;  // whether `end` is known
  double length = 0;   // of the last step
  double ahead = 0;    // when J is about to lose rank, where the loop stopped for that; else NaN

  std::vector<double> crossings;  // when J lost rank

 private:
  enum class Made {
    all,      // a step, to be recorded
    shorter,  // none yet: the next one tried is shorter
    none,     // none: it is Python's
  };
  Made step(const Stretch& stretch, Watch::Rank& after);
  Made leap(const Stretch& stretch, double left, Watch::Rank& after);
  bool outputs(const Stretch& stretch, bool leapt, In times, Eigen::Index& due, Eigen::Ref<Matrix> rows,
               Eigen::Index& filled);

  System& system_;
  Method& method_;
  Watch& watch_;
  Crossing& crossing_;
  Record& record_;
  Vector y_out_;
};

}  // namespace ckc
