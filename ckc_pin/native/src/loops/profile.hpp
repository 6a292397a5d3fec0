// Optional profile: how often each term was evaluated, and for how long.
#pragma once

#include <array>
#include <chrono>

namespace ckc {

struct Profile {
  enum Term { phi, J, phi_z, rho, D_tree, D, bias_tree, C_tree, terms };
  static constexpr const char* names[] = {"phi", "J", "phi_z", "rho", "D_tree", "D", "bias_tree", "C_tree"};

  bool on = false;
  std::array<long, terms> calls{};
  std::array<double, terms> seconds{};

  // Times one evaluation from construction to destruction.
  class Entry {
   public:
    Entry(Profile& profile, Term term) : profile_(profile.on ? &profile : nullptr), term_(term) {
      if (profile_) start_ = Clock::now();
    }
    ~Entry() {
      if (!profile_) return;
      ++profile_->calls[term_];
      profile_->seconds[term_] += std::chrono::duration<double>(Clock::now() - start_).count();
    }
    Entry(const Entry&) = delete;
    Entry& operator=(const Entry&) = delete;

   private:
    using Clock = std::chrono::steady_clock;
    Profile* profile_;
    Term term_;
    Clock::time_point start_;
  };
};

}  // namespace ckc
