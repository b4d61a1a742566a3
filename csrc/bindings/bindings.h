// What every binding file shares: the list of them, and views of memory that Python owns.
//
// Arguments are raw addresses and sizes that the layer's _ops*.py has checked (dtype, contiguity,
// size), so nothing is converted or copied behind the caller's back.
#pragma once

#include <nanobind/nanobind.h>

#include <cstdint>

namespace diffsim {

namespace nb = nanobind;
using Address = std::uintptr_t;

void bind_cholesky(nb::module_& m);
void bind_copter_flight(nb::module_& m);
void bind_copter_control(nb::module_& m);
void bind_cpu(nb::module_& m);
void bind_ode(nb::module_& m);
void bind_rod(nb::module_& m);
void bind_signals(nb::module_& m);
void bind_soft(nb::module_& m);
void bind_soft_contact(nb::module_& m);
void bind_stokes(nb::module_& m);
void bind_svd(nb::module_& m);
void bind_water(nb::module_& m);

inline const double* in(Address a) { return reinterpret_cast<const double*>(a); }
inline double* out(Address a) { return reinterpret_cast<double*>(a); }
inline const std::int64_t* in_index(Address a) { return reinterpret_cast<const std::int64_t*>(a); }
inline std::int64_t* out_index(Address a) { return reinterpret_cast<std::int64_t*>(a); }

}  // namespace diffsim
