// What the kernels share that must not be compiled for one of them.
#include "network/lstm_lanes.hpp"

#include <algorithm>
#include <atomic>
#include <exception>
#include <thread>
#include <vector>

namespace tauext::lanes {
const float kSaturation = 20.0f;

void parallel_chunks(int chunks, int threads, void (*body)(int chunk, int thread, void* context), void* context) {
  if (threads < 1) throw Error("threads = " + std::to_string(threads) + " must be >= 1");
  threads = std::min(threads, std::max(chunks, 1));
  std::atomic<int> next{0};
  std::vector<std::exception_ptr> failure(threads);
  auto work = [&](int thread) noexcept {
    try {
      for (int chunk; (chunk = next.fetch_add(1)) < chunks;) body(chunk, thread, context);
    } catch (...) {
      failure[thread] = std::current_exception();
    }
  };
  {
    std::vector<std::jthread> pool;
    for (int thread = 1; thread < threads; ++thread) pool.emplace_back(work, thread);
    work(0);
  }
  for (const std::exception_ptr& e : failure)
    if (e) std::rethrow_exception(e);
}

}  // namespace tauext::lanes
