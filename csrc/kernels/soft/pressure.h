// Pressure in pneumatic chambers: energy -sum p V(x), its gradient, tangent, and adjoint.
//
//   V = -1/6 sum over triangles of x_a . (x_b x x_c)
// since normals point into the cavity (chambers.h). Positive gauge pressure pushes the walls apart.
// V is trilinear and its surface closed, so the force is a potential one that sums to zero, with a
// symmetric, indefinite geometric stiffness. The energy is unbounded below: a pressure that the
// material cannot hold inflates the body without limit.
#pragma once

#include "kernels/parallel.h"
#include "kernels/soft/soft_model.h"

namespace diffsim {

/// Adds the gradient of -sum p V [N].
/// @param[in] pressure  (num_chambers,) gauge pressures [Pa]; null: none
/// @return -sum p V [J]
double add_pressure_gradient(const SoftModel& model, const double* pressure, const double* x,
                             double* gradient, ThreadPool& pool);

/// Adds the geometric stiffness, d^2(-sum p V)/dx^2 [N/m], in the model's layout.
void add_pressure_tangent(const SoftModel& model, const double* pressure, const double* x,
                          double* values, ThreadPool& pool);

/// z . d(gradient)/dp per chamber, overwritten, (num_chambers,); nothing for null `out`.
void pressure_adjoint(const SoftModel& model, const double* x, const double* z, double* out,
                      ThreadPool& pool);

/// Derivatives of z . (gradient(x) + H(x) d), H = d^2(-sum p V)/dx^2, nothing for a null `out`.
/// @param[out] force  (num_nodes, 3) added: d/dx with x + d held fixed
/// @param[out] out    (num_chambers,) by the pressures, overwritten
void linearized_pressure_adjoint(const SoftModel& model, const double* pressure, const double* x,
                                 const double* d, const double* z, double* force, double* out,
                                 ThreadPool& pool);

/// Adds gradient(x) + H(x) d of the pressures given [N].
void add_linearized_pressure(const SoftModel& model, const double* pressure, const double* x,
                             const double* d, double* force, ThreadPool& pool);

}  // namespace diffsim
