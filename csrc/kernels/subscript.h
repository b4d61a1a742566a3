// Counts are signed; what indexes a container is not.
#pragma once

#include <cstddef>
#include <cstdint>

namespace diffsim {

inline std::size_t at(std::int64_t i) { return static_cast<std::size_t>(i); }
/// The same, in files where `at` is the name of a place.
inline std::size_t u(std::int64_t i) { return at(i); }

}  // namespace diffsim
