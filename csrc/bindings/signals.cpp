// Signals on their way; diffsim/causes/_ops_signals.py checks the arguments.
#include "bindings/bindings.h"
#include "kernels/signals/follow.h"

namespace diffsim {

void bind_signals(nb::module_& m) {
  m.def("follow", [](bool has_play, std::int64_t num_rows, std::int64_t num_times, Address targets,
                     Address room, std::int64_t room_stride, Address states) {
    nb::gil_scoped_release release;
    follow(has_play ? Follow::play : Follow::slowed, num_rows, num_times, in(targets), in(room),
           room_stride, out(states));
  });
  m.def("approach", [](std::int64_t num_rows, std::int64_t num_times, Address targets,
                       Address steps, Address most, Address fastest, bool held, Address places) {
    nb::gil_scoped_release release;
    approach(num_rows, num_times, in(targets), in(steps), in(most), in(fastest), held, out(places));
  });
  m.def("approach_adjoint",
        [](std::int64_t num_rows, std::int64_t num_times, Address targets, Address steps,
           Address most, Address fastest, bool held, Address slope, Address of_targets,
           Address of_most, Address of_fastest) {
          nb::gil_scoped_release release;
          approach_adjoint(num_rows, num_times, in(targets), in(steps), in(most), in(fastest), held,
                           in(slope), out(of_targets), out(of_most), out(of_fastest));
        });
  m.def("find_intervals", [](std::int64_t num_times, Address times, std::int64_t num_places,
                             Address places, bool of_equal_after, Address found) {
    nb::gil_scoped_release release;
    find_intervals(num_times, in(times), num_places, in(places), of_equal_after, out_index(found));
  });
}

}  // namespace diffsim
