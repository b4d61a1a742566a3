// How a Cholesky factorization is split into tasks, and where their intermediate results live.
#pragma once

#include "kernels/linalg/cholesky_symbolic.h"

namespace diffsim {

/// Fills tasks, levels, and the offsets of fronts and solve workspace.
void schedule_cholesky(CholeskySymbolic& symbolic);

}  // namespace diffsim
