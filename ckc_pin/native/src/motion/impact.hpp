// Simultaneous impacts at one or several stops, resolved in rounds of generalized reflections.
//
// Let g = N v' be the gap rates (positive where a joint leaves its stop) and A = N D'^-1 N^T, with D' restricted to
// the motions that the loops allow. In each round all approaching stops, g < 0, are reflected together:
//
// v+ = v_p - e v_o,
//
// where v_p is the projection of v- on the cone {g >= 0} of these stops in the metric of D', and v_o = v- - v_p.
// Since v_p and v_o are orthogonal in that metric (Moreau's decomposition), a round removes (1 - e^2) / 2 |v_o|^2 >=
// 0 of the kinetic energy. Rounds follow each other until no stop is approached. See Smith, Kaufman, Vouga, Tamstorf,
// Grinspun, "Reflections on simultaneous impact", ACM Trans. Graph. 31, 2012.
#pragma once

#include <functional>

#include "tree/types.hpp"

namespace ckc {

struct ImpactProblem {
  Matrix A;                 // (m, m), positive semidefinite, with a positive diagonal
  Vector gap_rates;         // (m), before the impact
  Vector restitution;       // (m), from 0 to 1
  Vector rest_speed;        // (m): a joint rests at its stop if |gap rate| is not larger
  Vector min_bounce_speed;  // (m): slower bounces are suppressed
};

// Called after each round with the stops that took part, the impulses (m) and the restitution of the round. Impulses
// are not negative, unless they remove a slow bounce.
using ImpactRound = std::function<bool(const Indices& stops, const Vector& impulses, double restitution)>;

// Compute the gap rates after the impact, (m), zero where a joint rests at its stop. False if a quadratic program fails
// or `round` returns false.
bool resolve_impact(const ImpactProblem& problem, const ImpactRound& round, Vector& gap_rates);

}  // namespace ckc
