// A pool of threads that lives as long as one kernel call.
//
// Kernels take an explicit thread count and own no threads between calls, so a process may fork
// safely. Results must not depend on the number of threads: split work into tasks whose number and
// content do not depend on it, and combine partial results in task order.
#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <type_traits>
#include <vector>

namespace diffsim {

class ThreadPool {
 public:
  /// @param num_threads workers including the caller; 1 starts no thread at all.
  /// @throws std::runtime_error the system refuses to start so many.
  explicit ThreadPool(int num_threads) {
    try {
      for (int i = 1; i < num_threads; ++i) workers_.emplace_back([this] { work(); });
    } catch (const std::exception& error) {  // std::system_error, std::bad_alloc
      const std::string started = std::to_string(workers_.size() + 1);
      end();
      throw std::runtime_error("num_threads is " + std::to_string(num_threads) +
                               ", and the system refused to start more than " + started + " (" +
                               error.what() + "); give fewer");
    }
  }
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;
  ~ThreadPool() { end(); }

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
    open_.store(true);  // sequentially consistent, see work()
    announce();
    drain();
    open_.store(false);
    for (int spin = 0; active_.load() != 0; ++spin) pause(spin);
  }

  /// Calls f(begin, end) for ranges of `size` that cover [0, n), in any order, and waits.
  template <typename F>
  void run_ranges(std::int64_t n, std::int64_t size, F&& f) {
    run((n + size - 1) / size,
        [&](std::int64_t task) { f(task * size, std::min(n, (task + 1) * size)); });
  }

 private:
  void end() {
    stop_.store(true, std::memory_order_release);
    announce();
    for (std::thread& t : workers_) t.join();
  }

  void drain() {
    for (std::int64_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < num_tasks_;)
      call_(object_, i);
  }

  void work() {
    std::uint64_t seen = 0;
    while (true) {
      for (int spin = 0; generation_.load() == seen; ++spin) {
        if (spin < kSpins)
          pause(spin);
        else
          sleep(seen);
      }
      seen = generation_.load();  // those slept through are over
      if (stop_.load(std::memory_order_acquire)) return;
      // Whoever enters before looking is either seen by the caller, who closes before looking and
      // then waits, or sees that the generation is closed (both sides sequentially consistent). The
      // caller need not wait for workers that the system has not let run yet.
      active_.fetch_add(1);
      if (open_.load()) drain();
      active_.fetch_sub(1);
    }
  }

  /// Starts a generation of work and wakes those who sleep.
  void announce() {
    generation_.fetch_add(1);  // sequentially consistent, as is sleepers_: no wake-up is lost
    if (sleepers_.load() > 0) {
      const std::lock_guard<std::mutex> lock(mutex_);
      wake_.notify_all();
    }
  }

  void sleep(std::uint64_t seen) {
    std::unique_lock<std::mutex> lock(mutex_);
    sleepers_.fetch_add(1);
    wake_.wait(lock, [&] { return generation_.load() != seen; });
    sleepers_.fetch_sub(1);
  }

  // Regions follow one another within microseconds, so workers spin before they sleep; the caller
  // only yields, since what it waits for is already running.
  static constexpr int kSpins = 4000;
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
  std::atomic<bool> open_{false};
  std::atomic<int> active_{0};
  std::atomic<std::uint64_t> generation_{0};
  std::atomic<bool> stop_{false};
  std::atomic<int> sleepers_{0};
  std::mutex mutex_;
  std::condition_variable wake_;
};

}  // namespace diffsim
