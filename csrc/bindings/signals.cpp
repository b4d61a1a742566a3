// Signals on their way; diffsim/causes/_ops_signals.py checks the arguments.
#include "bindings/bindings.h"
#include "kernels/signals/approach.h"
#include "kernels/signals/follow.h"

namespace diffsim {

void bind_signals(nb::module_& m) {
  m.def("follow", [](bool has_play, std::int64_t num_rows, std::int64_t num_times, Address targets,
                     Address room, std::int64_t room_stride, Address states) {
    nb::gil_scoped_release release;
    follow(has_play ? Follow::play : Follow::slowed, num_rows, num_times, in(targets), in(room),
           room_stride, out(states));
  });
  m.def(
      "approach",
      [](std::int64_t num_rows, std::int64_t num_times, bool held, Address targets, Address steps,
         Address most, Address fastest, Address places) {
        nb::gil_scoped_release release;
        approach({num_rows, num_times, in(targets), in(steps), in(most), in(fastest), held},
                 out(places));
      },
      nb::arg("num_rows"), nb::arg("num_times"), nb::arg("held"), nb::arg("targets"),
      nb::arg("steps"), nb::arg("most"), nb::arg("fastest"), nb::arg("places"));
  m.def(
      "approach_vjp",
      [](std::int64_t num_rows, std::int64_t num_times, bool held, Address targets, Address steps,
         Address most, Address fastest, Address grad_places, Address grad_targets,
         Address grad_most, Address grad_fastest) {
        nb::gil_scoped_release release;
        approach_vjp({num_rows, num_times, in(targets), in(steps), in(most), in(fastest), held},
                     in(grad_places), out(grad_targets), out(grad_most), out(grad_fastest));
      },
      nb::arg("num_rows"), nb::arg("num_times"), nb::arg("held"), nb::arg("targets"),
      nb::arg("steps"), nb::arg("most"), nb::arg("fastest"), nb::arg("grad_places"),
      nb::arg("grad_targets"), nb::arg("grad_most"), nb::arg("grad_fastest"));
  m.def(
      "approach_tangent",
      [](std::int64_t num_rows, std::int64_t num_times, bool held, Address targets, Address steps,
         Address most, Address fastest, Address d_targets, Address d_most, Address d_fastest,
         Address d_places) {
        nb::gil_scoped_release release;
        approach_tangent({num_rows, num_times, in(targets), in(steps), in(most), in(fastest), held},
                         in(d_targets), in(d_most), in(d_fastest), out(d_places));
      },
      nb::arg("num_rows"), nb::arg("num_times"), nb::arg("held"), nb::arg("targets"),
      nb::arg("steps"), nb::arg("most"), nb::arg("fastest"), nb::arg("d_targets"),
      nb::arg("d_most"), nb::arg("d_fastest"), nb::arg("d_places"));
  m.def("find_intervals", [](std::int64_t num_times, Address times, std::int64_t num_places,
                             Address places, bool of_equal_after, Address found) {
    nb::gil_scoped_release release;
    find_intervals(num_times, in(times), num_places, in(places), of_equal_after, out_index(found));
  });
}

}  // namespace diffsim
