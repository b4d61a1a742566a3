// Huge pages where the system offers them.
#pragma once

#include <cstddef>
#include <cstdint>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace diffsim {

constexpr std::size_t kHugePage = std::size_t{1} << 21;

/// Ask for huge pages before memory is touched for the first time; a hint that may be refused.
/// Without them the system's work per page of 4 KB costs as much as what is computed into it.
inline void on_huge_pages(void* memory, std::size_t bytes) {
#if defined(__linux__)
  constexpr std::uintptr_t kPage = 4096;
  const auto address = reinterpret_cast<std::uintptr_t>(memory);
  const std::uintptr_t skipped = (kPage - address % kPage) % kPage;
  if (bytes < kHugePage) return;
  madvise(reinterpret_cast<void*>(address + skipped), bytes - skipped, MADV_HUGEPAGE);
#else
  (void)memory, (void)bytes;
#endif
}

}  // namespace diffsim
