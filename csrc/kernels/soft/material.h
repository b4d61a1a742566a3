// The solid's energy as a policy: which one is chosen once per kernel call, not per sample.
//
// A material has
//   kName              its name in Python
//   kWeights           number of its element parameters, its *weights*
//   kKeepsSamples      whether samples cost more to make than to read from memory
//   kJetsInFrame       whether its jets are taken in the principal frame of F
//   Sample<T>          what its energy is made of, of one deformation gradient per lane; where made
//                      of its principal frame, stress and tangent are in principal axes, else in F
//   stress(sample, w)  writes the stresses [Pa], returns the energy density [J/m^3]
//   tangent(sample, w) returns d^2 psi in principal axes, or writes dP/dF
//   jets(from, F)      writes the stress that each weight multiplies, along two directions at once;
//                      from: what jet_source() returns
// Energies are linear in the weights w; see each material for what these mean.
#pragma once

#include <new>
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

/// Whether a material is written in principal axes.
template <typename M>
inline constexpr bool kIsPrincipal =
    std::is_base_of_v<PrincipalFrame<Native>, typename M::template Sample<Native>>;

/// Samples of `count` registers of deformation gradients, into memory that holds none.
/// @param kMost  the most registers there may be
template <typename M, int kMost>
void make_samples(const Native (*F)[9], int count, typename M::template Sample<Native>* out) {
  using Sample = typename M::template Sample<Native>;
  if constexpr (kIsPrincipal<M>) {
    PrincipalFrame<Native> frames[kMost];
    principal_frames(F, count, frames);
    if constexpr (std::is_same_v<M, PdMaterial>)
      Sample::make(frames, count, out);
    else
      for (int r = 0; r < count; ++r) new (out + r) Sample(frames[r]);
  } else if constexpr (std::is_same_v<M, CorotatedMaterial>) {
    Sample::make(F, count, out);
  } else {
    for (int r = 0; r < count; ++r) new (out + r) Sample(F[r]);
  }
}

/// First Piola stress [Pa]; returns psi [J/m^3].
template <typename M, class T>
T stress(const typename M::template Sample<T>& sample, const T w[M::kWeights], T P[9]) {
  if constexpr (kIsPrincipal<M>) {
    T d[3];
    const T psi = M::stress(sample, w, d);
    compose(sample.U, d, sample.V, P);
    return psi;
  } else {
    return M::stress(sample, w, P);
  }
}

/// P : Z of each weight's own stress P.
template <typename M, class T>
void unit_products(const typename M::template Sample<T>& sample, const T Z[9], T out[M::kWeights]) {
  T along[9];  // in principal axes: d_i u_i . Z v_i
  if constexpr (kIsPrincipal<M>)
    for (int i = 0; i < 3; ++i) {
      T Zv[3];
      for (int a = 0; a < 3; ++a)
        Zv[a] = Z[3 * a] * sample.V[i] + Z[3 * a + 1] * sample.V[3 + i] +
                Z[3 * a + 2] * sample.V[6 + i];
      along[i] = sample.U[i] * Zv[0] + sample.U[3 + i] * Zv[1] + sample.U[6 + i] * Zv[2];
    }
#pragma GCC unroll 4  // what the weights have in common is then computed once
  for (int k = 0; k < M::kWeights; ++k) {
    T unit[M::kWeights] = {}, P[9];
    unit[k] = broadcast<T>(1.0);
    M::stress(sample, unit, P);
    if constexpr (kIsPrincipal<M>)
      out[k] = P[0] * along[0] + P[1] * along[1] + P[2] * along[2];
    else
      out[k] = dot9(P, Z);
  }
}

/// The nearest positive semidefinite dP/dF, for Newton: by what the tangent is in principal axes.
template <typename M, class T>
__attribute__((noinline)) void clamped_tangent(const T F[9], const T w[M::kWeights], T H[81]) {
  const PrincipalFrame<T> frame = principal_frame(F);
  T stretch[9] = {}, own[81];
  for (int i = 0; i < 3; ++i) stretch[4 * i] = frame.s[i];
  M::tangent(typename M::template Sample<T>(stretch), w, own);
  PrincipalTangent<T> core;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      core.diagonal[3 * i + j] = own[i <= j ? 36 * i + 4 * j : 36 * j + 4 * i];
  for (int k = 0; k < 3; ++k) {
    const int ij = 3 * kPair[k][0] + kPair[k][1], ji = 3 * kPair[k][1] + kPair[k][0];
    core.symmetric[k] = own[10 * ij] + own[9 * ij + ji];
    core.skew[k] = own[10 * ij] - own[9 * ij + ji];
  }
  clamp_tangent(core);
  expand_tangent(frame, core, H);
}

/// dP/dF, on and above the diagonal.
/// @param clamp  the nearest positive semidefinite one
template <typename M, class T>
void stiffness(const typename M::template Sample<T>& sample, const T w[M::kWeights], bool clamp,
               T H[81]) {
  if constexpr (kIsPrincipal<M>) {
    PrincipalTangent<T> core = M::tangent(sample, w);
    if (clamp) clamp_tangent(core);
    expand_tangent(sample, core, H);
  } else if (clamp) {
    clamped_tangent<M>(sample.F, w, H);
  } else {
    M::tangent(sample, w, H);
  }
}

/// What a material's jets are made of: the sample, or the principal frame of its F.
template <typename M, class T>
decltype(auto) jet_source(const typename M::template Sample<T>& sample) {
  if constexpr (M::kJetsInFrame && !kIsPrincipal<M>)
    return principal_frame(sample.F);
  else
    return (sample);
}

}  // namespace diffsim
