// Laws of the solid and of fibers along two directions at once (jets.h), part by part: what the
// derivatives of a linearized force are made of.
#pragma once

#include "kernels/soft/element_stage.h"
#include "kernels/soft/jets.h"

namespace diffsim::elements {

/// U^T A V.
template <class T>
void into_frame(const PrincipalFrame<T>& frame, const T A[9], T out[9]) {
  T AV[9];
  times(A, frame.V, AV);
  transpose_times(frame.U, AV, out);
}

/// The law of the solid along two directions of F, in the principal frame of F where its jets are.
template <typename M>
struct SolidJets {
  PrincipalFrame<Native> frame;   // of those jets
  Native first[9];                // the first direction
  Jet<Native> P[M::kWeights][9];  // the stress that each weight multiplies

  void fill(const typename M::template Sample<Native>& sample, const Native A[9],
            const Native B[9]) {
    const auto& source = jet_source<M, Native>(sample);
    Jet<Native> F[9];
    if constexpr (M::kJetsInFrame) {
      Native second[9];
      frame = source;
      into_frame(source, A, first);
      into_frame(source, B, second);
      for (int i = 0; i < 9; ++i)
        F[i] = {i % 4 == 0 ? source.s[i / 4] : Native{}, first[i], second[i], Native{}};
    } else {
      std::copy(A, A + 9, first);
      for (int i = 0; i < 9; ++i) F[i] = {sample.F[i], A[i], B[i], Native{}};
    }
    M::jets(source, F, P);
  }

  /// A matrix of the jets' frame as it is in the axes of F.
  void out_of_frame(const Native A[9], Native out[9]) const {
    if constexpr (!M::kJetsInFrame) {
      std::copy(A, A + 9, out);
    } else {
      Native UA[9];
      times(frame.U, A, UA);
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
          out[3 * i + j] = UA[3 * i] * frame.V[3 * j] + UA[3 * i + 1] * frame.V[3 * j + 1] +
                           UA[3 * i + 2] * frame.V[3 * j + 2];
    }
  }
};

/// The fibers of a part along two directions of F; their stress is `stiffness` times `pulled` times
/// the direction.
struct FiberJets {
  Native direction[3];
  Native first[3];                 // the first direction of l = F m
  Jet<Native> unit[3], pulled[3];  // l/|l|, and l - activation l/|l|
  Native stiffness, taut;          // of the pull, and one where it pulls

  template <typename Group>
  void fill(const SoftModel& model, const SoftParameters& p, Index g, int part, const Native F[9],
            const Native A[9], const Native B[9]) {
    const FiberPart f = fiber_part<Group>(model, p, g, part, F);
    const Native* m = f.state.direction;
    const Native activation = Group::part_value(model.fiber, g, part, p.activation);
    stiffness = f.pull.stiffness;
    taut = select(less(broadcast<Native>(0.0), abs(f.pull.stiffness)), broadcast<Native>(1.0),
                  Native{});
    Jet<Native> l[3];
    for (int i = 0; i < 3; ++i) {
      direction[i] = m[i];
      first[i] = A[3 * i] * m[0] + A[3 * i + 1] * m[1] + A[3 * i + 2] * m[2];
      const Native Bm = B[3 * i] * m[0] + B[3 * i + 1] * m[1] + B[3 * i + 2] * m[2];
      l[i] = {f.state.unit[i] * f.state.length, first[i], Bm, Native{}};
    }
    const Jet<Native> over = inverse(square_root(l[0] * l[0] + l[1] * l[1] + l[2] * l[2]));
    for (int i = 0; i < 3; ++i) {
      unit[i] = over * l[i];
      const Jet<Native> scaled{activation * unit[i].v, activation * unit[i].a,
                               activation * unit[i].b, activation * unit[i].ab};
      pulled[i] = l[i] - scaled;
    }
  }
};

}  // namespace diffsim::elements
