// Initial value problems given by tapes; diffsim/ode/_ops.py checks the arguments.
#include "bindings/bindings.h"
#include "bindings/python_stop.h"
#include "kernels/ode/integrate.h"

namespace diffsim {

namespace {

/// A problem whose memory Python keeps alive while the object lives.
struct OdeAddresses {
  Address code, ends, rate_out, reading_out, constants, times, lower, upper, held;
  std::int64_t num_code, num_states, num_inputs, num_parameters, num_constants, num_channels,
      num_samples, num_steps, batch, input_stride, time_stride;

  OdeProblem problem() const {
    const std::int64_t num_given = 1 + num_states + num_inputs + num_parameters + num_constants;
    OdeProblem p;
    p.tape = {reinterpret_cast<const TapeInstruction*>(code), in_index(ends), num_code, num_given};
    p.rate_out = in_index(rate_out);
    p.reading_out = in_index(reading_out);
    p.constants = in(constants);
    p.times = in(times);
    p.lower = in(lower);
    p.upper = in(upper);
    p.held = in_index(held);
    p.num_states = num_states;
    p.num_inputs = num_inputs;
    p.num_parameters = num_parameters;
    p.num_constants = num_constants;
    p.num_channels = num_channels;
    p.num_samples = num_samples;
    p.num_steps = num_steps;
    p.batch = batch;
    p.input_stride = input_stride;
    p.time_stride = time_stride;
    return p;
  }
};

}  // namespace

void bind_ode(nb::module_& m) {
  nb::class_<OdeAddresses>(m, "OdeAddresses")
      .def(nb::init<>())
      .def_rw("code", &OdeAddresses::code)
      .def_rw("ends", &OdeAddresses::ends)
      .def_rw("rate_out", &OdeAddresses::rate_out)
      .def_rw("reading_out", &OdeAddresses::reading_out)
      .def_rw("constants", &OdeAddresses::constants)
      .def_rw("times", &OdeAddresses::times)
      .def_rw("lower", &OdeAddresses::lower)
      .def_rw("upper", &OdeAddresses::upper)
      .def_rw("held", &OdeAddresses::held)
      .def_rw("num_code", &OdeAddresses::num_code)
      .def_rw("num_states", &OdeAddresses::num_states)
      .def_rw("num_inputs", &OdeAddresses::num_inputs)
      .def_rw("num_parameters", &OdeAddresses::num_parameters)
      .def_rw("num_constants", &OdeAddresses::num_constants)
      .def_rw("num_channels", &OdeAddresses::num_channels)
      .def_rw("num_samples", &OdeAddresses::num_samples)
      .def_rw("num_steps", &OdeAddresses::num_steps)
      .def_rw("batch", &OdeAddresses::batch)
      .def_rw("input_stride", &OdeAddresses::input_stride)
      .def_rw("time_stride", &OdeAddresses::time_stride);
  m.def(
      "ode_integrate",
      [](const OdeAddresses& problem, Address start, Address inputs, Address parameters,
         Address readings, Address states, int num_threads) {
        run_interruptibly([&](Stop& stop) {
          integrate(problem.problem(), in(start), in(inputs), in(parameters), out(readings),
                    out(states), num_threads, stop);
        });
      },
      nb::arg("problem"), nb::arg("start"), nb::arg("inputs"), nb::arg("parameters"),
      nb::arg("readings"), nb::arg("states"), nb::arg("num_threads"));
  m.def(
      "ode_integrate_vjp",
      [](const OdeAddresses& problem, Address inputs, Address parameters, Address states,
         Address grad_readings, Address grad_states, Address grad_start, Address grad_inputs,
         Address grad_parameters, int num_threads) {
        run_interruptibly([&](Stop& stop) {
          integrate_vjp(problem.problem(), in(inputs), in(parameters), in(states),
                        in(grad_readings), in(grad_states), out(grad_start), out(grad_inputs),
                        out(grad_parameters), num_threads, stop);
        });
      },
      nb::arg("problem"), nb::arg("inputs"), nb::arg("parameters"), nb::arg("states"),
      nb::arg("grad_readings"), nb::arg("grad_states"), nb::arg("grad_start"),
      nb::arg("grad_inputs"), nb::arg("grad_parameters"), nb::arg("num_threads"));
  m.def(
      "ode_integrate_tangent",
      [](const OdeAddresses& problem, Address start, Address inputs, Address parameters,
         Address d_start, Address d_inputs, Address d_parameters, Address d_readings,
         Address d_states, int num_threads) {
        run_interruptibly([&](Stop& stop) {
          integrate_tangent(problem.problem(), in(start), in(inputs), in(parameters), in(d_start),
                            in(d_inputs), in(d_parameters), out(d_readings), out(d_states),
                            num_threads, stop);
        });
      },
      nb::arg("problem"), nb::arg("start"), nb::arg("inputs"), nb::arg("parameters"),
      nb::arg("d_start"), nb::arg("d_inputs"), nb::arg("d_parameters"), nb::arg("d_readings"),
      nb::arg("d_states"), nb::arg("num_threads"));
}

}  // namespace diffsim
