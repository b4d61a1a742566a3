// What this binary was compiled for, so that Python can report it.
#include "bindings/bindings.h"

namespace diffsim {

void bind_cpu(nb::module_& m) {
#if defined(__AVX512F__)
  m.attr("instruction_set") = "avx512";
#elif defined(__AVX2__)
  m.attr("instruction_set") = "avx2";
#else
  m.attr("instruction_set") = "baseline";
#endif
}

}  // namespace diffsim
