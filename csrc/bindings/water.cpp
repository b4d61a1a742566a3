// The force of water on a soft body's surface; diffsim/soft/_ops_water.py checks the arguments.
#include "bindings/bindings.h"
#include "kernels/soft/water_force.h"

namespace diffsim {
namespace {

/// Addresses that Python fills by name.
struct WaterArrays {
  Address x = 0, v = 0, water = 0, density = 0, drag = 0, thrust = 0;

  WaterInputs inputs() const {
    WaterInputs given;
    given.x = in(x);
    given.v = in(v);
    given.water = in(water);
    given.density = in(density);
    given.drag = in(drag);
    given.thrust = in(thrust);
    return given;
  }
  WaterAdjoint adjoint() const {
    WaterAdjoint grads;
    grads.x = out(x);
    grads.v = out(v);
    grads.water = out(water);
    grads.density = out(density);
    grads.drag = out(drag);
    grads.thrust = out(thrust);
    return grads;
  }
};

}  // namespace

void bind_water(nb::module_& m) {
  nb::class_<WaterFaces>(m, "WaterFaces")
      .def(
          "__init__",
          [](WaterFaces* self, Address nodes, std::int64_t num_faces, int corners,
             std::int64_t num_nodes) {
            new (self) WaterFaces{num_nodes, num_faces, corners, in_index(nodes)};
          },
          nb::kw_only(), nb::arg("nodes"), nb::arg("num_faces"), nb::arg("corners"),
          nb::arg("num_nodes"));
  nb::class_<WaterArrays>(m, "WaterArrays")
      .def(
          "__init__",
          [](WaterArrays* self, Address x, Address v, Address water, Address density, Address drag,
             Address thrust) { new (self) WaterArrays{x, v, water, density, drag, thrust}; },
          nb::kw_only(), nb::arg("x"), nb::arg("v"), nb::arg("water"), nb::arg("density"),
          nb::arg("drag"), nb::arg("thrust"));
  m.def(
      "water_force",
      [](const WaterFaces& faces, const WaterArrays& inputs, double fade_angle, std::int64_t batch,
         Address force) {
        nb::gil_scoped_release release;
        water_force(faces, inputs.inputs(), fade_angle, batch, out(force));
      },
      nb::kw_only(), nb::arg("faces"), nb::arg("inputs"), nb::arg("fade_angle"), nb::arg("batch"),
      nb::arg("force"));
  m.def(
      "water_force_adjoint",
      [](const WaterFaces& faces, const WaterArrays& inputs, double fade_angle, std::int64_t batch,
         Address grad_force, const WaterArrays& grads) {
        nb::gil_scoped_release release;
        water_force_adjoint(faces, inputs.inputs(), fade_angle, batch, in(grad_force),
                            grads.adjoint());
      },
      nb::kw_only(), nb::arg("faces"), nb::arg("inputs"), nb::arg("fade_angle"), nb::arg("batch"),
      nb::arg("grad_force"), nb::arg("grads"));
  m.def(
      "water_force_tangent",
      [](const WaterFaces& faces, const WaterArrays& inputs, double fade_angle, std::int64_t batch,
         const WaterArrays& directions, Address rate) {
        nb::gil_scoped_release release;
        water_force_tangent(faces, inputs.inputs(), fade_angle, batch, directions.inputs(),
                            out(rate));
      },
      nb::kw_only(), nb::arg("faces"), nb::arg("inputs"), nb::arg("fade_angle"), nb::arg("batch"),
      nb::arg("directions"), nb::arg("rate"));
}

}  // namespace diffsim
