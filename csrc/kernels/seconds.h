// The clock that reports of a solver read.
#pragma once

#include <chrono>

namespace diffsim {

/// Time [s] since some moment of the past; it never runs backwards.
inline double seconds() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

}  // namespace diffsim
