// Flight of multicopters; diffsim/copter/dynamics/_ops_flight.py checks the arguments.
#include <nanobind/stl/string.h>

#include "bindings/bindings.h"
#include "bindings/python_stop.h"
#include "kernels/copter/flight.h"

namespace diffsim {

namespace {

using namespace nb::literals;

/// Addresses and strides that Python fills by name.
struct FlightArray {
  Address address = 0;
  std::int64_t vehicle_stride = 0, step_stride = 0;

  FlightRows rows() const { return {in(address), vehicle_stride, step_stride}; }
  FlightGrads grads(const FlightArray& of) const {
    return {out(address), of.vehicle_stride == 0, vehicle_stride, step_stride};
  }
};

struct FlightArrays {
  FlightArray start, feed_forward, gain, reference, wind, parameters;

  FlightInputs inputs() const {
    return {start.rows(),     feed_forward.rows(), gain.rows(),
            reference.rows(), wind.rows(),         parameters.rows()};
  }
  FlightInputGrads grads(const FlightArrays& of) const {
    return {start.grads(of.start), feed_forward.grads(of.feed_forward),
            gain.grads(of.gain),   reference.grads(of.reference),
            wind.grads(of.wind),   parameters.grads(of.parameters)};
  }
};

}  // namespace

void bind_copter_flight(nb::module_& m) {
  nb::class_<FlightArray>(m, "FlightArray")
      .def(nb::init<>())
      .def_rw("address", &FlightArray::address)
      .def_rw("vehicle_stride", &FlightArray::vehicle_stride)
      .def_rw("step_stride", &FlightArray::step_stride);
  nb::class_<FlightArrays>(m, "FlightArrays")
      .def(nb::init<>())
      .def_rw("start", &FlightArrays::start)
      .def_rw("feed_forward", &FlightArrays::feed_forward)
      .def_rw("gain", &FlightArrays::gain)
      .def_rw("reference", &FlightArrays::reference)
      .def_rw("wind", &FlightArrays::wind)
      .def_rw("parameters", &FlightArrays::parameters);
  nb::class_<FlightOptions>(m, "FlightOptions")
      .def(nb::init<>())
      .def_rw("dt", &FlightOptions::dt)
      .def_rw("gravity", &FlightOptions::gravity)
      .def_rw("substeps", &FlightOptions::substeps)
      .def_rw("feedback", &FlightOptions::feedback)
      .def_rw("motor_lag", &FlightOptions::motor_lag)
      .def_rw("thrust_curve", &FlightOptions::thrust_curve)
      .def_rw("rotor_drag", &FlightOptions::rotor_drag)
      .def_rw("body_drag", &FlightOptions::body_drag)
      .def_rw("ground_effect", &FlightOptions::ground_effect)
      .def_rw("interference", &FlightOptions::interference)
      .def_rw("battery", &FlightOptions::battery)
      .def_rw("free_thrusts", &FlightOptions::free_thrusts)
      .def_rw("end_alone", &FlightOptions::end_alone);
  m.attr("FLIGHT_BODY") = kBody;
  m.attr("FLIGHT_GROUP") = kGroup;
  m.attr("FLIGHT_MAX_ROTORS") = kMaxRotors;
  m.def("flight_fields", [](int num_rotors) {
    nb::list fields;  // (name, size) in the order of the row
    for (const FlightField& field : kFlightFields) {
      fields.append(nb::make_tuple(field.name, field.size(num_rotors)));
    }
    return fields;
  });
  m.def(
      "flight_rollout",
      [](int num_rotors, std::int64_t batch, std::int64_t steps, const FlightOptions& options,
         const FlightArrays& inputs, Address records, int num_threads) {
        run_interruptibly([&](Stop& stop) {
          flight_rollout(num_rotors, batch, steps, options, inputs.inputs(), out(records),
                         num_threads, stop);
        });
      },
      nb::kw_only(), "num_rotors"_a, "batch"_a, "steps"_a, "options"_a, "inputs"_a, "records"_a,
      "num_threads"_a);
  m.def(
      "flight_rollout_vjp",
      [](int num_rotors, std::int64_t batch, std::int64_t steps, const FlightOptions& options,
         const FlightArrays& inputs, Address records, Address grad_records,
         const FlightArrays& grads, int num_threads) {
        run_interruptibly([&](Stop& stop) {
          flight_rollout_vjp(num_rotors, batch, steps, options, inputs.inputs(), in(records),
                             in(grad_records), grads.grads(inputs), num_threads, stop);
        });
      },
      nb::kw_only(), "num_rotors"_a, "batch"_a, "steps"_a, "options"_a, "inputs"_a, "records"_a,
      "grad_records"_a, "grads"_a, "num_threads"_a);
  m.def(
      "flight_rollout_tangent",
      [](int num_rotors, std::int64_t batch, std::int64_t steps, const FlightOptions& options,
         const FlightArrays& inputs, const FlightArrays& directions, Address rates,
         int num_threads) {
        run_interruptibly([&](Stop& stop) {
          flight_rollout_tangent(num_rotors, batch, steps, options, inputs.inputs(),
                                 directions.inputs(), out(rates), num_threads, stop);
        });
      },
      nb::kw_only(), "num_rotors"_a, "batch"_a, "steps"_a, "options"_a, "inputs"_a, "directions"_a,
      "rates"_a, "num_threads"_a);
}

}  // namespace diffsim
