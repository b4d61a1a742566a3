// The solid's energy as a policy: which one is chosen once per kernel call, not per sample.
//
// A material has a Sample<T>, made from the principal frames of one deformation gradient per lane,
// and two functions of it: stress() writes the principal stresses [Pa] and returns the energy
// density [J/m^3], tangent() returns d^2 psi in principal axes. Both are linear in the element
// parameters w_mu and w_vol (see each material for what these mean).
#pragma once

#include "kernels/soft/hyperelastic.h"
#include "kernels/soft/pd_material.h"
#include "kernels/soft/soft_model.h"

namespace diffsim {

/// Calls f(policy) with the policy of a material.
template <typename F>
decltype(auto) with_material(Material material, F&& f) {
  switch (material) {
    case Material::kCorotated:
      return f(CorotatedMaterial{});
    case Material::kStableNeoHookean:
      return f(StableNeoHookeanMaterial{});
    case Material::kNeoHookean:
      return f(NeoHookeanMaterial{});
    case Material::kStvk:
      return f(StvkMaterial{});
    case Material::kPd:
      break;
  }
  return f(PdMaterial{});
}

/// First Piola stress P = U diag(d) V^T [Pa]; returns psi [J/m^3].
template <typename M, class T>
T stress(const typename M::template Sample<T>& sample, const T& w_mu, const T& w_vol, T P[9]) {
  T d[3];
  const T psi = M::stress(sample, w_mu, w_vol, d);
  compose(sample.U, d, sample.V, P);
  return psi;
}

}  // namespace diffsim
