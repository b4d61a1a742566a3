// A pool of threads that lives as long as one kernel call.
//
// Kernels take an explicit thread count and own no threads between calls, so a process may fork
// safely. Results must not depend on the number of threads: split work into tasks whose number and
// content do not depend on it, and combine partial results in task order.
#pragma once

#include <atomic>
#include <cstdint>
#include <thread>
#include <type_traits>
#include <vector>

namespace diffsim {

class ThreadPool {
 public:
  /// @param num_threads workers including the caller; 1 starts no thread at all.
  explicit ThreadPool(int num_threads) {
    for (int i = 1; i < num_threads; ++i) workers_.emplace_back([this] { work(); });
  }
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;
  ~ThreadPool() {
    stop_.store(true, std::memory_order_release);
    generation_.fetch_add(1, std::memory_order_release);
    for (std::thread& t : workers_) t.join();
  }

  int size() const { return static_cast<int>(workers_.size()) + 1; }

  /// Calls f(task) for every task in [0, num_tasks), in any order, and waits. f must not throw.
  template <typename F>
  void run(std::int64_t num_tasks, F&& f) {
    if (workers_.empty() || num_tasks <= 1) {
      for (std::int64_t i = 0; i < num_tasks; ++i) f(i);
      return;
    }
    call_ = [](void* object, std::int64_t i) {
      (*static_cast<std::remove_reference_t<F>*>(object))(i);
    };
    object_ = const_cast<void*>(static_cast<const void*>(&f));
    num_tasks_ = num_tasks;
    next_.store(0, std::memory_order_relaxed);
    busy_.store(static_cast<int>(workers_.size()), std::memory_order_relaxed);
    generation_.fetch_add(1, std::memory_order_release);
    drain();
    for (int spin = 0; busy_.load(std::memory_order_acquire) != 0; ++spin) pause(spin);
  }

 private:
  void drain() {
    for (std::int64_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < num_tasks_;)
      call_(object_, i);
  }

  void work() {
    std::uint64_t seen = 0;
    while (true) {
      for (int spin = 0; generation_.load(std::memory_order_acquire) == seen; ++spin) pause(spin);
      ++seen;
      if (stop_.load(std::memory_order_acquire)) return;
      drain();
      busy_.fetch_sub(1, std::memory_order_release);
    }
  }

  // Regions follow one another within microseconds: spin first, then let others have the core.
  static void pause(int spin) {
    if (spin < 2000) {
#if defined(__x86_64__)
      __builtin_ia32_pause();
#endif
    } else {
      std::this_thread::yield();
    }
  }

  std::vector<std::thread> workers_;
  void (*call_)(void*, std::int64_t) = nullptr;
  void* object_ = nullptr;
  std::int64_t num_tasks_ = 0;
  std::atomic<std::int64_t> next_{0};
  std::atomic<int> busy_{0};
  std::atomic<std::uint64_t> generation_{0};
  std::atomic<bool> stop_{false};
};

}  // namespace diffsim
