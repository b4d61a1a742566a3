// Drag and thrust of water on the boundary faces of a mesh (thesis eqs. 5.3, 5.4), with derivatives
// in both modes. diffsim/soft/hydrodynamics.py states the formulas.
#pragma once

#include <cstdint>

namespace diffsim {

/// Faces that meet the water: quads or triangles, outward by the right hand.
struct WaterFaces {
  std::int64_t num_nodes = 0, num_faces = 0;
  int corners = 4;                      // 3 or 4
  const std::int64_t* nodes = nullptr;  // (num_faces, corners)
};

/// What the force depends on, or its directions, which may be null where nothing moves.
struct WaterInputs {
  const double* x = nullptr;        // (batch, num_nodes, 3) [m]
  const double* v = nullptr;        // (batch, num_nodes, 3) [m/s]
  const double* water = nullptr;    // (batch, 3) velocity of the water [m/s]
  const double* density = nullptr;  // (1,) [kg/m^3]
  const double* drag = nullptr;     // (4,) ordinates of the curve of C_d [-]
  const double* thrust = nullptr;   // (4,) of C_t [-]
};

/// Gradients of the inputs, of the same shapes, overwritten.
struct WaterAdjoint {
  double* x = nullptr;
  double* v = nullptr;
  double* water = nullptr;
  double* density = nullptr;
  double* drag = nullptr;
  double* thrust = nullptr;
};

/// @param[in]  fade_angle  angle of attack below which the force fades [rad]; 0: it does not
/// @param[out] force       (batch, num_nodes, 3) [N], each member's from its faces in their order
void water_force(const WaterFaces& faces, const WaterInputs& in, double fade_angle,
                 std::int64_t batch, double* force);

/// @param[in] grad_force  (batch, num_nodes, 3)
void water_force_adjoint(const WaterFaces& faces, const WaterInputs& in, double fade_angle,
                         std::int64_t batch, const double* grad_force, const WaterAdjoint& out);

/// @param[out] rate  (batch, num_nodes, 3), the force along one direction of all inputs
void water_force_tangent(const WaterFaces& faces, const WaterInputs& in, double fade_angle,
                         std::int64_t batch, const WaterInputs& direction, double* rate);

}  // namespace diffsim
