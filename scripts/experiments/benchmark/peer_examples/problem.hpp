// The benchmark's problem in C++, for programs that docs/report/peers.md explains: read it, print the motion.
#pragma once
#include <Eigen/Dense>
#include <array>
#include <boost/property_tree/json_parser.hpp>
#include <chrono>
#include <iostream>
#include <vector>

using Json = boost::property_tree::ptree;
using Vector = Eigen::VectorXd;
using State = std::vector<double>;  // q, then v

struct Body {
  int parent;  // 0 is the world, k the body bodies[k - 1]
  std::string joint;
  Eigen::Matrix3d R, inertia;
  Eigen::Vector3d p, axis, center;
  double mass;
};

struct Point {
  int body;
  Eigen::Vector3d local;
};

struct Problem {
  Json json;  // everything, for what the other members leave out
  std::string unsupported;  // why points cannot express the loops; empty if they can
  Eigen::Vector3d gravity;
  std::vector<Body> bodies;
  std::vector<std::array<Point, 2>> pairs;  // points that coincide
  Vector armature, stiffness, rest, damping, force;
  State start;
  std::vector<double> instants;
  double rtol, budget_s;
};

inline Vector numbers(const Json& node) {  // of a list, or of a list of lists
  if (node.empty()) return node.data().empty() ? Vector(0) : Vector(Vector::Constant(1, std::stod(node.data())));
  State all;
  for (const auto& [key, child] : node)
    for (double number : numbers(child)) all.push_back(number);
  return Vector::Map(all.data(), all.size());
}
inline Vector numbers(const Json& node, const char* key) { return numbers(node.get_child(key)); }
inline Eigen::Matrix3d matrix(const Json& node, const char* key) {
  return Eigen::Matrix3d::Map(numbers(node, key).data()).transpose();
}

inline Problem read_problem(std::istream& input) {
  Problem problem;
  Json& json = problem.json;
  read_json(input, json);
  problem.gravity = numbers(json, "gravity");
  for (const auto& [_, b] : json.get_child("bodies"))
    problem.bodies.push_back({b.get<int>("parent"), b.get<std::string>("joint"), matrix(b, "rotation"),
                              matrix(b, "inertia"), numbers(b, "translation"), numbers(b, "axis"),
                              numbers(b, "center"), b.get<double>("mass")});
  if (json.get<std::string>("pairs") == "null") problem.unsupported = "it closes loops by points only";
  for (const auto& [_, pair] : json.get_child("pairs")) {
    std::array<Point, 2> ends;
    for (int k : {0, 1}) {
      const Json& end = pair.get_child(k ? "b" : "a");
      ends[k] = {end.get<int>("body"), numbers(end, "point")};
    }
    problem.pairs.push_back(ends);
  }
  const Json& joints = json.get_child("joints");
  problem.armature = numbers(joints, "armature"), problem.stiffness = numbers(joints, "stiffness");
  problem.rest = numbers(joints, "rest"), problem.damping = numbers(joints, "damping");
  problem.force = numbers(joints, "force");
  for (const char* key : {"q", "v"})
    for (double number : numbers(json, key)) problem.start.push_back(number);
  const Vector instants = numbers(json, "instants");
  problem.instants.assign(instants.begin(), instants.end());
  problem.rtol = json.get<double>("rtol"), problem.budget_s = json.get<double>("budget_s");
  return problem;
}

inline void print(const char* name, const double* first, std::size_t count) {
  std::cout << '"' << name << "\": [";
  for (std::size_t k = 0; k < count; ++k) std::cout << (k ? ", " : "") << first[k];
  std::cout << "]";
}

// Run integrate(states), which returns the state at every instant, several times, and print motion and shortest time.
template <class Integrate>
void print_motion(const Problem& problem, Integrate integrate, const std::size_t& rhs, std::size_t nq) {
  std::vector<State> states;
  double shortest = HUGE_VAL, spent = 0;
  for (int repeat = 0; repeat < 4 && spent < problem.budget_s / 2; ++repeat) {
    const auto start = std::chrono::steady_clock::now();
    states = integrate();
    const double wall = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    shortest = std::min(shortest, wall), spent += wall;
  }
  for (std::size_t k = 0; k < states.size(); ++k) {
    std::cout << "{\"t\": " << problem.instants[k] << ", ";
    print("q", states[k].data(), nq), std::cout << ", ";
    print("v", states[k].data() + nq, states[k].size() - nq), std::cout << "}\n";
  }
  std::cout << "{\"wall_s\": " << shortest << ", \"rhs\": " << rhs << "}\n";
}
