// The extension module: one binary per instruction set, torch-free.
#include <nanobind/nanobind.h>

#include "bindings/bindings.h"

#define DIFFSIM_EXPAND(name, m) NB_MODULE(name, m)

DIFFSIM_EXPAND(DIFFSIM_MODULE, m) {
  // Bodies that a program still holds when the interpreter exits are no leak; tests/soft counts the
  // prepared objects that outlive their body.
  nanobind::set_leak_warnings(false);
  diffsim::bind_cholesky(m);
  diffsim::bind_copter_flight(m);
  diffsim::bind_copter_control(m);
  diffsim::bind_cpu(m);
  diffsim::bind_ode(m);
  diffsim::bind_rod(m);
  diffsim::bind_signals(m);
  diffsim::bind_soft(m);
  diffsim::bind_soft_contact(m);
  diffsim::bind_stokes(m);
  diffsim::bind_svd(m);
  diffsim::bind_water(m);
}
