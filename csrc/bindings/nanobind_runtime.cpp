// nanobind's runtime, compiled into the extension (it ships as one source file).
#include "nb_combined.cpp"  // NOLINT(bugprone-suspicious-include)
