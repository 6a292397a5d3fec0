#include "tree.hpp"

#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/energy.hpp>
#include <pinocchio/algorithm/jacobian.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/multibody.hpp>
#include <pinocchio/serialization.hpp>

namespace ckc {

namespace pin = pinocchio;

struct Tree::Workspace {
  pin::Model model;
  pin::Data data;
  explicit Workspace(pin::Model&& given) : model(std::move(given)), data(model) {}
};

static pin::Model read(const std::string& serialized) {
  pin::Model model;
  pin::serialization::loadFromString(model, serialized);
  return model;
}

Tree::Tree(const std::string& serialized, Indices place_) : place(std::move(place_)) {
  own = std::make_unique<Workspace>(read(serialized));
  const pin::Model& model = own->model;
  n = model.nv, nq = model.nq, joints = model.njoints;
  flat = n == nq;
  support.resize(joints);
  ancestors.resize(n);
  for (int joint = 1; joint < joints; ++joint) {
    support[joint] = support[model.parents[joint]];
    for (int k = model.idx_vs[joint]; k < model.idx_vs[joint] + model.nvs[joint]; ++k) {
      support[joint].push_back(k);
      ancestors[k] = support[joint];
    }
  }
}

Tree::~Tree() = default;

void Tree::set(In q) { pin::computeJointJacobians(own->model, own->data, q); }

const Matrix6x& Tree::jacobian() const { return own->data.J; }

Matrix3 Tree::rotation(int joint) const { return own->data.oMi[joint].rotation(); }

Vector3 Tree::translation(int joint) const { return own->data.oMi[joint].translation(); }

void Tree::inertia(In q) { pin::crba(own->model, own->data, q, pin::Convention::WORLD); }

const Matrix& Tree::D() const { return own->data.M; }

const Vector& Tree::bias(In q, In v) { return pin::nonLinearEffects(own->model, own->data, q, v); }

Vector6 Tree::velocity(int joint) const { return own->data.oMi[joint].act(own->data.v[joint]).toVector(); }

Vector6 Tree::acceleration(int joint) const {
  // nonLinearEffects lets the world fall upwards instead of the bodies down
  return own->data.oMi[joint].act(own->data.a_gf[joint]).toVector() + own->model.gravity.toVector();
}

const Vector& Tree::gravity(In q) { return pin::computeGeneralizedGravity(own->model, own->data, q); }

const Matrix& Tree::coriolis(In q, In v) { return pin::computeCoriolisMatrix(own->model, own->data, q, v); }

const Matrix6x& Tree::jacobian_dot() const { return own->data.dJ; }

const Matrix6x& Tree::jacobian_rate(In q, In v) {
  return pin::computeJointJacobiansTimeVariation(own->model, own->data, q, v);
}

double Tree::potential_energy(In q) { return pin::computePotentialEnergy(own->model, own->data, q); }

Vector3 log3(const Matrix3& rotation) { return pin::log3(rotation); }

std::string pinocchio_version() { return PINOCCHIO_VERSION; }

}  // namespace ckc
