// Kernels that run long hear Ctrl-C: Python's handlers of signals are called between their steps.
#pragma once

#include <atomic>
#include <chrono>
#include <thread>

#include "bindings/bindings.h"
#include "kernels/stop.h"

namespace diffsim {

class PythonStop final : public Stop {
 public:
  bool asked() noexcept override {
    if (stopped_.load(std::memory_order_relaxed)) return true;
    // only the thread that Python called may call it back
    if (std::this_thread::get_id() != caller_ || ++calls_ % kCalls != 0) return false;
    const Clock::time_point now = Clock::now();
    if (now < next_) return false;
    next_ = now + kPause;
    const nb::gil_scoped_acquire gil;
    if (PyErr_CheckSignals() != 0) stopped_.store(true, std::memory_order_relaxed);
    return stopped_.load(std::memory_order_relaxed);
  }

  /// Throws what a handler raised; the caller holds Python's lock.
  void raise_if_stopped() const {
    if (stopped_.load()) throw nb::python_error();
  }

 private:
  using Clock = std::chrono::steady_clock;
  static constexpr std::chrono::milliseconds kPause{50};  // between two looks at signals
  static constexpr unsigned kCalls = 64;                  // between two looks at the clock

  const std::thread::id caller_ = std::this_thread::get_id();
  Clock::time_point next_ = Clock::now() + kPause;
  unsigned calls_ = 0;
  std::atomic<bool> stopped_ = false;
};

/// Calls f(stop) without Python's lock.
template <typename F>
void run_interruptibly(F&& f) {
  PythonStop stop;
  {
    const nb::gil_scoped_release release;
    f(stop);
  }
  stop.raise_if_stopped();
}

}  // namespace diffsim
