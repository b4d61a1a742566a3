// Derivatives of the elastic force by the tables that hold the rest shape.
//
// A sample of weight w has F = sum_a x_a b_a^T, b_a = grad N_a, and the force w P(F) b_a on node a.
// Along nodal vectors z, with Z = sum_a z_a b_a^T, it does the work w P : Z, of which
//   d/db_a = w (P^T z_a + H^T x_a),  H = dP/dF Z,  and  d/dw = P : Z.
// Where the stress also depends on F of other positions (the frames of damping.h), each adds its
// own d(P : Z)/dF with its own positions. What the tables are of the rest positions X is up to the
// caller (diffsim/soft/elements.py). For isoparametric elements, db_a = -(grad dX)^T b_a and
// dw = w tr(grad dX), so that both together are Eshelby's form,
//   d/dX_a = w ((P : Z) I - F^T H - Z^T P) b_a.
// A linearly implicit step (linear_step.h) has P(F) + dP/dF D instead, D = sum_a d_a b_a^T, and
// damping at x + d: derivatives along D are added to those of x and z, and d has its own.
// Fibers have their own P and H, and a direction m besides: d/dm = w (Z^T P + F^T H) m, |m| = 1.
#pragma once

#include "kernels/soft/elasticity.h"

namespace diffsim {

/// z . d(gradient)/d(tables) and d(directions of fibers), damping included, overwritten.
/// @param[in] d  (num_nodes, 3) the gradient is linearized at x along d; null: the one at x
void shape_adjoint(const SoftModel& model, const SoftParameters& parameters,
                   const DampingFrames& frames, const double* x, const double* d, const double* z,
                   const ParameterAdjoint& out, ThreadPool& pool);

/// dE/d(tables) and d(directions of fibers) of E, without damping, overwritten.
void shape_slopes(const SoftModel& model, const SoftParameters& parameters, const double* x,
                  const ParameterAdjoint& out, ThreadPool& pool);

/// Adds d(gradient)/d(tables) and d(directions of fibers) along direction k to a vectors buffer.
void add_shape_tangent(const SoftModel& model, const SoftParameters& parameters,
                       const DampingFrames& frames, const double* x, const double* d,
                       std::int64_t k, const ParameterDirections& directions, double* vectors,
                       ThreadPool& pool);

}  // namespace diffsim
