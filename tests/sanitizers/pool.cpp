// The thread pool under load: many short regions, pools in several threads at once, sleepers.
// Built by tests/sanitizers/test_sanitizers.py with a sanitizer; ends with 0 if all sums are right.
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <numeric>
#include <thread>
#include <vector>

#include "kernels/parallel.h"

namespace {

/// Sum of squares of [0, n), in tasks whose partial sums are combined in order.
bool sums(diffsim::ThreadPool& pool, std::int64_t tasks) {
  std::vector<std::int64_t> part(static_cast<std::size_t>(tasks), 0);
  pool.run(tasks, [&](std::int64_t i) {
    for (std::int64_t k = 0; k < 50; ++k) part[static_cast<std::size_t>(i)] += i * k;
#ifdef MISTAKE  // what the sanitizers must see: a race, and a write past the end
    const volatile std::int64_t nothing = 0;
    part[0] += nothing;
    std::this_thread::sleep_for(std::chrono::microseconds(100));  // others take tasks meanwhile
    if (i == tasks - 1) part.data()[MISTAKE] = 0;
#endif
  });
  const std::int64_t want = 1225 * tasks * (tasks - 1) / 2;
  return std::accumulate(part.begin(), part.end(), std::int64_t{0}) == want;
}

bool regions(int num_threads, int rounds) {
  diffsim::ThreadPool pool(num_threads);
  bool right = pool.size() == num_threads;
  for (int round = 0; round < rounds; ++round) {
    right = sums(pool, round % 7) && right;  // none and one task, fewer and more than threads
    if (round % 50 == 49)                    // long enough for the workers to fall asleep
      std::this_thread::sleep_for(std::chrono::milliseconds(2));
  }
  return right;
}

}  // namespace

int main() {
  bool right = true;
  for (int num_threads : {1, 2, 3, 8}) right = regions(num_threads, 400) && right;
  for (int k = 0; k < 50; ++k) diffsim::ThreadPool idle(4);  // ended before they worked
  std::vector<char> each(3, 0);
  std::vector<std::thread> callers;
  for (std::size_t k = 0; k < each.size(); ++k)
    callers.emplace_back([&each, k] { each[k] = regions(3, 200) ? 1 : 0; });
  for (std::thread& caller : callers) caller.join();
  for (char one : each) right = right && one != 0;
  std::puts(right ? "right" : "WRONG");
  return right ? 0 : 1;
}
