// The solid's energy as a policy: which one is chosen once per kernel call, not per sample.
//
// A material has
//   kName              its name in Python
//   kWeights           number of its element parameters, its *weights*
//   Sample<T>          what its energy is made of, from the principal frames of one deformation
//                      gradient per lane
//   stress(sample, w)  writes the principal stresses [Pa], returns the energy density [J/m^3]
//   tangent(sample, w) returns d^2 psi in principal axes
//   jets(sample, F)    writes the stress that each weight multiplies, along two directions at once
// Energies are linear in the weights w; see each material for what these mean.
#pragma once

#include <stdexcept>
#include <string>
#include <string_view>
#include <tuple>

#include "kernels/soft/hyperelastic.h"
#include "kernels/soft/pd_material.h"
#include "kernels/soft/soft_model.h"

namespace diffsim {

/// All there are; a Material is a place among them.
using Materials = std::tuple<PdMaterial, CorotatedMaterial, StableNeoHookeanMaterial,
                             NeoHookeanMaterial, StvkMaterial, MooneyRivlinMaterial>;
inline constexpr int kMaterials = static_cast<int>(std::tuple_size_v<Materials>);

/// Calls f(policy) with the policy of a material.
template <int kPlace = 0, typename F>
decltype(auto) with_material(Material material, F&& f) {
  if constexpr (kPlace + 1 < kMaterials)
    if (static_cast<int>(material) != kPlace)
      return with_material<kPlace + 1>(material, std::forward<F>(f));
  return f(std::tuple_element_t<kPlace, Materials>{});
}

/// The material of a name; throws std::invalid_argument where there is none.
inline Material find_material(std::string_view name) {
  for (int k = 0; k < kMaterials; ++k) {
    const Material material{k};
    if (with_material(material, [&](auto law) { return name == decltype(law)::kName; }))
      return material;
  }
  throw std::invalid_argument("no material is named " + std::string(name));
}

/// First Piola stress P = U diag(d) V^T [Pa]; returns psi [J/m^3].
template <typename M, class T>
T stress(const typename M::template Sample<T>& sample, const T w[M::kWeights], T P[9]) {
  T d[3];
  const T psi = M::stress(sample, w, d);
  compose(sample.U, d, sample.V, P);
  return psi;
}

}  // namespace diffsim
