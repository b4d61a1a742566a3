// Whether a caller wants a long kernel to end before its work is done.
#pragma once

namespace diffsim {

class Stop {
 public:
  virtual ~Stop() = default;

  /// Asked between steps, from any thread. Once it is true, the kernel returns; what it wrote is of
  /// no use.
  virtual bool asked() noexcept = 0;
};

}  // namespace diffsim
