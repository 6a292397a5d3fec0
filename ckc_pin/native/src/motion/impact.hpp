// Impacts of one instant at one or several stops, resolved in rounds of generalized reflections.
//
// In terms of the gap velocities g = N v' (positive where a joint leaves its stop) and A = N D'^-1 N^T, D' restricted to
// the motions that the loops allow. In a round all stops that approach, g < 0, are reflected together:
//
//   v+ = v_p - e v_o,
//
// where v_p is the projection of v- on the cone {g >= 0} of these stops in the metric of D', and v_o = v- - v_p the part
// that the projection removes. v_p and v_o are orthogonal in that metric (Moreau's decomposition), so that a round takes
// (1 - e^2) / 2 |v_o|^2 >= 0 of the kinetic energy, whatever the masses. Rounds follow each other until no stop is
// approached. Smith, Kaufman, Vouga, Tamstorf, Grinspun, "Reflections on simultaneous impact", ACM Trans. Graph. 31, 2012.
#pragma once

#include <functional>

#include "tree/types.hpp"

namespace ckc {

struct ImpactProblem {
  Matrix A;            // (m, m), positive semidefinite, with a positive diagonal
  Vector g;            // (m), before the impact
  Vector restitution;  // (m), from 0 to 1
  Vector at_rest;      // (m): a stop rests where |g| is no larger
  Vector slow;         // (m): a stop that is left at a lower speed is not left
};

// Called after each round with the stops that took part, the impulses of all of them, (m), not negative but where they
// take away a slow bounce, and the restitution of the round.
using ImpactRound = std::function<bool(const Indices& stops, const Vector& impulses, double restitution)>;

// Find the gap velocities after the impact, (m), zero where a stop rests. False where a quadratic program fails, or `round`
// returned false.
bool resolve_impact(const ImpactProblem& problem, const ImpactRound& round, Vector& g);

}  // namespace ckc
