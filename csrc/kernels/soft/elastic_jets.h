// The law of fibers along two directions at once (jets.h), part by part: what the derivatives of a
// linearized force are made of, with that of the solid (solid_law.h).
#pragma once

#include "kernels/soft/solid_law.h"

namespace diffsim::elements {

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
