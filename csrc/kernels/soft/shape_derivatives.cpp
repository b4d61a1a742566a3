#include "kernels/soft/shape_derivatives.h"

#include "kernels/soft/damping.h"
#include "kernels/soft/elastic_jets.h"
#include "kernels/soft/hourglass.h"

namespace diffsim {
namespace {

using namespace elements;

template <typename Group>
SampleLaw fiber_law(const SoftModel& model, const SoftParameters& p, Index g, int part,
                    const Native F[9]) {
  SampleLaw law;
  const FiberPart f = fiber_part<Group>(model, p, g, part, F);
  law.psi = fiber_stress(f.state, f.pull, law.P);
  add_fiber_tangent(f.state, f.pull, false, law.H);
  return law;
}

/// Stress of the solid's law along two directions, in the axes of F.
struct StressJets {
  Native v[9], a[9], b[9], ab[9];

  StressJets(const SolidJets& jets, int num_weights, const LawWeights& w) {
    Native sum[4][9] = {};
    for (int i = 0; i < 9; ++i)
      for (int k = 0; k < num_weights; ++k) {
        const Jet<Native>& P = jets.P[k][i];
        sum[0][i] += w[at(k)] * P.v, sum[1][i] += w[at(k)] * P.a;
        sum[2][i] += w[at(k)] * P.b, sum[3][i] += w[at(k)] * P.ab;
      }
    jets.out_of_frame(sum[0], v), jets.out_of_frame(sum[1], a);
    jets.out_of_frame(sum[2], b), jets.out_of_frame(sum[3], ab);
  }
  explicit StressJets(const FiberJets& jets) {
    for (int i = 0; i < 9; ++i) {
      const Jet<Native>& pulled = jets.pulled[i / 3];
      const Native m = jets.stiffness * jets.direction[i % 3];
      v[i] = pulled.v * m, a[i] = pulled.a * m, b[i] = pulled.b * m, ab[i] = pulled.ab * m;
    }
  }
};

/// Damping of a sample: strain rate S and its stress T(S), see damping.h.
struct Viscous {
  Native mu, lambda, Fn[9], delta[9], TS[9];

  template <typename Group>
  Viscous(Group, const ElementBlock& solid, const SoftParameters& p, const DampingFrame& frame,
          const Native F[9], Index g, int part)
      : mu(Group::part_value(solid, g, part, p.damp_mu)),
        lambda(Group::part_value(solid, g, part, p.damp_lambda)) {
    split_matrix(frame.Fn, part, Fn);
    split_matrix(frame.Fv, part, delta);
    for (int i = 0; i < 9; ++i) delta[i] = F[i] - delta[i];
    stress_of(Fn, delta, TS);
  }
  /// T(sym(A^T B)).
  void stress_of(const Native A[9], const Native B[9], Native out[9]) const {
    Native S[9];
    strain_rate(A, B, S);
    viscous(S, mu, lambda, out);
  }
};

void add9(const Native A[9], Native sum[9]) {
  for (int i = 0; i < 9; ++i) sum[i] += A[i];
}
void add_times(const Native A[9], const Native B[9], Native sum[9]) {
  Native AB[9];
  times(A, B, AB);
  add9(AB, sum);
}

/// out = A m, m the direction of the fibers.
template <typename Group>
void along_fiber(const SoftModel& model, Index g, int part, const Native A[9], Native out[3]) {
  for (int i = 0; i < 3; ++i) {
    out[i] = Native{};
    for (int j = 0; j < 3; ++j)
      out[i] += A[3 * i + j] *
                Group::part_value(model.fiber, g, part, model.fiber_directions.data(), 3, j);
  }
}

/// Nodal vectors, and the derivative of a sample's work by their gradient.
template <typename Group>
struct NodesAlong {
  typename Group::NodeValue node[Group::kNodes][3];
  Native by[kParts][9] = {};

  NodesAlong(const ElementBlock& block, Index g, const double* values) {
    Group::gather(block, g, values, node);
  }
};

/// Derivatives of a sample's work by its gradients of x, z and d.
template <typename Group>
struct WorkAlong {
  NodesAlong<Group> x, z, d;

  WorkAlong(const ElementBlock& block, Index g, const double* x, const double* d, const double* z)
      : x(block, g, x), z(block, g, z ? z : x), d(block, g, d ? d : x) {}

  void fill(int part, const SampleLaw& law, const Native Z[9]) {
    std::copy(law.P, law.P + 9, z.by[part]);
    multiply_upper(law.H, Z, x.by[part]);
  }
  /// Of the stress linearized along d, by jets along z and d.
  void fill(int part, const StressJets& P) {
    for (int i = 0; i < 9; ++i) {
      z.by[part][i] = P.v[i] + P.b[i];
      x.by[part][i] = P.a[i] + P.ab[i];
      d.by[part][i] = P.a[i];
    }
  }
};

/// Adds w sum_n by_n^T node_n to the gradients in the tables.
template <typename Group, typename... Nodes>
void add_gradients(const ElementBlock& block, const TableLanes<Group>& lanes, Index g,
                   double* tables, const Nodes&... along) {
  for (int part = 0; part < kParts; ++part) {
    const Native weight = split(Group::shape(block, g).weight, part);
    for (int a = 0; a < Group::kNodes; ++a)
      for (int j = 0; j < 3; ++j) {
        Native sum{};
        for (int i = 0; i < 3; ++i)
          ((sum += along.by[part][3 * i + j] * Group::part_of(along.node[a][i], part)), ...);
        lanes.add(tables, g, part, 3 * a + j, weight * sum);
      }
  }
}

/// Adds the solid's derivatives to the tables; z null: those of E.
template <typename Group>
void solid_adjoint(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                   const double* x, const double* d, const double* z, double* tables,
                   ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const TableLanes<Group> lanes(solid);
  const SolidLaw solid_law(model);
  const bool is_damped = z && p.damp_mu;
  for_groups(solid, pool, [&](Index g) {
    const LawStage<Group> stage(solid_law, solid, g, 1, x);
    WorkAlong<Group> work(solid, g, x, d, z);
    NodesAlong<Group> frame(solid, g, is_damped ? frames.x_frame : x);
    NodesAlong<Group> velocity(solid, g, is_damped ? frames.x_velocity : x);
    Native Z[kParts][9], D[kParts][9] = {};
    if (z) deformation_gradient<Group>(solid, g, z, Z);
    if (d) deformation_gradient<Group>(solid, g, d, D);
    for (int part = 0; part < kParts; ++part) {
      const LawWeights w = solid_law.weights_at<Group>(solid, g, part, p.weights);
      if (!z) {
        SampleLaw law;
        solid_law.fill(stage.sample(part), w, law);
        std::copy(law.P, law.P + 9, work.x.by[part]);
        lanes.add(tables, g, part, lanes.kWeight, law.psi);
        continue;
      }
      if (d) {
        SolidJets jets;
        solid_law.jets(stage.sample(part), Z[part], D[part], jets);
        work.fill(part, StressJets(jets, solid_law.num_weights, w));
      } else {
        SampleLaw law;
        solid_law.fill(stage.sample(part), w, law);
        work.fill(part, law, Z[part]);
      }
      if (is_damped) {
        Native end[9], TY[9], FnTY[9];
        for (int i = 0; i < 9; ++i) end[i] = stage.F[part][i] + D[part][i];
        const Viscous v(Group{}, solid, p, frames.solid[at(g)], end, g, part);
        v.stress_of(v.Fn, Z[part], TY);
        times(v.Fn, TY, FnTY);
        add_times(v.Fn, v.TS, work.z.by[part]);
        add9(FnTY, work.x.by[part]);
        if (d) add9(FnTY, work.d.by[part]);
        add_times(Z[part], v.TS, frame.by[part]);
        add_times(v.delta, TY, frame.by[part]);
        for (int i = 0; i < 9; ++i) velocity.by[part][i] = -FnTY[i];
      }
      lanes.add(tables, g, part, lanes.kWeight, contract(work.z.by[part], Z[part]));
    }
    add_gradients(solid, lanes, g, tables, work.x, work.z, work.d, frame, velocity);
  });
}

/// The same of fibers, one after another: those of one element share its record.
template <typename Group>
void fiber_adjoint(const SoftModel& model, const SoftParameters& p, const double* x,
                   const double* d, const double* z, double* tables) {
  const ElementBlock& fiber = model.fiber;
  const TableLanes<Group> lanes(fiber, model.fiber_elements.data());
  for (Index g = 0; g < fiber.num_groups; ++g) {
    WorkAlong<Group> work(fiber, g, x, d, z);
    Native F[kParts][9], Z[kParts][9] = {}, D[kParts][9] = {}, by_direction[3][kParts];
    deformation_gradient<Group>(fiber, g, x, F);
    if (z) deformation_gradient<Group>(fiber, g, z, Z);
    if (d) deformation_gradient<Group>(fiber, g, d, D);
    for (int part = 0; part < kParts; ++part) {
      const SampleLaw law = fiber_law<Group>(model, p, g, part, F[part]);
      if (d) {
        FiberJets jets;
        jets.fill<Group>(model, p, g, part, F[part], Z[part], D[part]);
        work.fill(part, StressJets(jets));
      } else if (z) {
        work.fill(part, law, Z[part]);
      } else {
        std::copy(law.P, law.P + 9, work.x.by[part]);
      }
      lanes.add(tables, g, part, lanes.kWeight, z ? contract(work.z.by[part], Z[part]) : law.psi);
      Native all[9], other[9], turned[3];
      transpose_times(Z[part], work.z.by[part], all);
      transpose_times(F[part], work.x.by[part], other);
      add9(other, all);
      transpose_times(D[part], work.d.by[part], other);
      add9(other, all);
      along_fiber<Group>(model, g, part, all, turned);
      for (int i = 0; i < 3; ++i)
        by_direction[i][part] = split(Group::shape(fiber, g).weight, part) * turned[i];
    }
    add_gradients(fiber, lanes, g, tables, work.x, work.z, work.d);
    for (int i = 0; i < 3; ++i)
      Group::add_element_value(fiber, g, by_direction[i], tables + model.fiber_tables_start(), 3,
                               i);
  }
}

void adjoint_or_slopes(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                       const double* x, const double* d, const double* z,
                       const ParameterAdjoint& out, ThreadPool& pool) {
  if (!out.tables) return;
  std::fill(out.tables, out.tables + model.tables_size(), 0.0);
  with_group(model.solid, [&](auto group) {
    using Group = decltype(group);
    solid_adjoint<Group>(model, p, frames, x, d, z, out.tables, pool);
    fiber_adjoint<Group>(model, p, x, d, z, out.tables);
  });
  hourglass::add_shape_adjoint(model, p, frames, x, d, z, out.tables, pool);
}

/// How the tables of a group's samples move along direction k, with the weights that they have.
template <typename Group>
struct MovedShape {
  GroupShape<Group::kNodes> shape;
  Native weight[kParts];

  MovedShape(const ElementBlock& block, const TableLanes<Group>& lanes, const double* tables,
             Index g) {
    shape.weight = Group::shape(block, g).weight;
    for (int part = 0; part < kParts; ++part) {
      weight[part] = lanes.read(tables, g, part, lanes.kWeight);
      for (int k = 0; k < 3 * Group::kNodes; ++k)
        join(shape.grad[k / 3][k % 3], part, lanes.read(tables, g, part, k));
    }
  }

  /// Adds the forces of w P b_a along the moved tables, where P moves by dP.
  void add_forces(const ElementBlock& block, Index g, const Native (*P)[9], const Native (*dP)[9],
                  double* vectors) const {
    GroupShape<Group::kNodes> plain = Group::shape(block, g);
    Native sum[kParts][9];
    for (int part = 0; part < kParts; ++part)
      for (int i = 0; i < 9; ++i)
        sum[part][i] = split(plain.weight, part) * dP[part][i] + weight[part] * P[part][i];
    plain.weight = broadcast(1.0);
    alignas(64) double first[3 * Group::kNodes * kLanes], second[3 * Group::kNodes * kLanes];
    scatter_stress(Group{}, plain, sum, first);
    scatter_stress(Group{}, shape, P, second);
    double* out = vectors + g * block.vectors_size();
    for (Index i = 0; i < block.vectors_size(); ++i) out[i] += first[i] + second[i];
  }
};

/// P = P(F) + H D and dP along dF and dD, by jets along dF and D.
void linearize(const SampleLaw& law, const StressJets& jets, const Native dD[9], Native P[9],
               Native dP[9]) {
  multiply_upper(law.H, dD, dP);
  for (int i = 0; i < 9; ++i) {
    P[i] = jets.v[i] + jets.b[i];
    dP[i] += jets.a[i] + jets.ab[i];
  }
}

template <typename Group>
void solid_tangent(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                   const double* x, const double* d, const double* tables, double* vectors,
                   ThreadPool& pool) {
  const ElementBlock& solid = model.solid;
  const TableLanes<Group> lanes(solid);
  const SolidLaw solid_law(model);
  for_groups(solid, pool, [&](Index g) {
    const LawStage<Group> stage(solid_law, solid, g, 1, x);
    const MovedShape<Group> moved(solid, lanes, tables, g);
    Native dF[kParts][9], dFn[kParts][9], dFv[kParts][9], P[kParts][9], dP[kParts][9];
    Native D[kParts][9] = {}, dD[kParts][9] = {};
    deformation_gradient<Group>(solid, g, moved.shape, x, dF);
    if (d) {
      deformation_gradient<Group>(solid, g, d, D);
      deformation_gradient<Group>(solid, g, moved.shape, d, dD);
    }
    if (p.damp_mu) {
      deformation_gradient<Group>(solid, g, moved.shape, frames.x_frame, dFn);
      deformation_gradient<Group>(solid, g, moved.shape, frames.x_velocity, dFv);
    }
    for (int part = 0; part < kParts; ++part) {
      const LawWeights w = solid_law.weights_at<Group>(solid, g, part, p.weights);
      SampleLaw law;
      solid_law.fill(stage.sample(part), w, law);
      if (d) {
        SolidJets jets;
        solid_law.jets(stage.sample(part), dF[part], D[part], jets);
        const StressJets stress(jets, solid_law.num_weights, w);
        linearize(law, stress, dD[part], P[part], dP[part]);
      } else {
        std::copy(law.P, law.P + 9, P[part]);
        multiply_upper(law.H, dF[part], dP[part]);
      }
      if (!p.damp_mu) continue;
      Native end[9], dT[9], other[9];
      for (int i = 0; i < 9; ++i) end[i] = stage.F[part][i] + D[part][i];
      const Viscous v(Group{}, solid, p, frames.solid[at(g)], end, g, part);
      for (int i = 0; i < 9; ++i) dFv[part][i] = dF[part][i] + dD[part][i] - dFv[part][i];
      v.stress_of(dFn[part], v.delta, dT);
      v.stress_of(v.Fn, dFv[part], other);
      add9(other, dT);
      add_times(v.Fn, v.TS, P[part]);
      add_times(dFn[part], v.TS, dP[part]);
      add_times(v.Fn, dT, dP[part]);
    }
    moved.add_forces(solid, g, P, dP, vectors);
  });
}

/// Adds (A dm) m^T to dA: how A m moves with the direction m.
void add_turned(const Native A[9], const Native m[3], const Native dm[3], Native dA[9]) {
  for (int i = 0; i < 3; ++i) {
    const Native moving = A[3 * i] * dm[0] + A[3 * i + 1] * dm[1] + A[3 * i + 2] * dm[2];
    for (int j = 0; j < 3; ++j) dA[3 * i + j] += moving * m[j];
  }
}

template <typename Group>
void fiber_tangent(const SoftModel& model, const SoftParameters& p, const double* x,
                   const double* d, const double* tables, double* vectors, ThreadPool& pool) {
  const ElementBlock& fiber = model.fiber;
  const double* direction = tables + model.fiber_tables_start();
  const TableLanes<Group> lanes(fiber, model.fiber_elements.data());
  for_groups(fiber, pool, [&](Index g) {
    const MovedShape<Group> moved(fiber, lanes, tables, g);
    Native F[kParts][9], dF[kParts][9], P[kParts][9], dP[kParts][9];
    Native D[kParts][9] = {}, dD[kParts][9] = {};
    deformation_gradient<Group>(fiber, g, x, F);
    deformation_gradient<Group>(fiber, g, moved.shape, x, dF);
    if (d) {
      deformation_gradient<Group>(fiber, g, d, D);
      deformation_gradient<Group>(fiber, g, moved.shape, d, dD);
    }
    for (int part = 0; part < kParts; ++part) {
      const SampleLaw law = fiber_law<Group>(model, p, g, part, F[part]);
      Native m[3], dm[3], tension[3];
      for (int i = 0; i < 3; ++i) {
        m[i] = Group::part_value(fiber, g, part, model.fiber_directions.data(), 3, i);
        dm[i] = Group::part_value(fiber, g, part, direction, 3, i);
      }
      add_turned(F[part], m, dm, dF[part]);
      if (d) {
        add_turned(D[part], m, dm, dD[part]);
        FiberJets jets;
        jets.fill<Group>(model, p, g, part, F[part], dF[part], D[part]);
        linearize(law, StressJets(jets), dD[part], P[part], dP[part]);
      } else {
        std::copy(law.P, law.P + 9, P[part]);
        multiply_upper(law.H, dF[part], dP[part]);
      }
      along_fiber<Group>(model, g, part, P[part], tension);
      for (int i = 0; i < 9; ++i) dP[part][i] += tension[i / 3] * dm[i % 3];
    }
    moved.add_forces(fiber, g, P, dP, vectors + model.fiber_vectors_start);
  });
}

}  // namespace

void shape_adjoint(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                   const double* x, const double* d, const double* z, const ParameterAdjoint& out,
                   ThreadPool& pool) {
  adjoint_or_slopes(model, p, frames, x, d, z, out, pool);
}

void shape_slopes(const SoftModel& model, const SoftParameters& p, const double* x,
                  const ParameterAdjoint& out, ThreadPool& pool) {
  adjoint_or_slopes(model, p, {}, x, nullptr, nullptr, out, pool);
}

void add_shape_tangent(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                       const double* x, const double* d, Index k,
                       const ParameterDirections& directions, double* vectors, ThreadPool& pool) {
  if (!directions.tables) return;
  const double* tables = directions.tables + k * model.tables_size();
  with_group(model.solid, [&](auto group) {
    using Group = decltype(group);
    solid_tangent<Group>(model, p, frames, x, d, tables, vectors, pool);
    fiber_tangent<Group>(model, p, x, d, tables, vectors, pool);
  });
  hourglass::add_shape_tangent(model, p, frames, x, d, tables, vectors, pool);
}

}  // namespace diffsim
