// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <thread>
#include <type_traits>
#include <vector>

namespace splatbot {

// A fixed number of threads that sleep (never spin) until a loop is to be run. Tasks are handed out one by one, so
// which thread runs a task is not determined: a task must depend on its index alone. Workers stay on the CPUs that the
// process might use when the pool was made, and off the one that the caller is on.
class ThreadPool {
 public:
  explicit ThreadPool(unsigned threads);
  ~ThreadPool();
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  unsigned size() const noexcept { return size_; }

  // Calls task(i) for every i in [0, count) and returns when all are done. A caller does not wait for a pool that is
  // busy with another loop: it runs its tasks itself. So does a caller of lower priority than the pool's, for a
  // second after another has used it. The first exception of a task is rethrown here.
  template <class Task>
  void run(std::size_t count, Task&& task) {
    using Plain = std::remove_reference_t<Task>;
    run_erased(count, [](void* context, std::size_t i) { (*static_cast<Plain*>(context))(i); },
               const_cast<void*>(static_cast<const void*>(&task)));
  }

 private:
  using Function = void (*)(void*, std::size_t);
  struct Loop;

  void run_erased(std::size_t count, Function function, void* context);
  void work();
  void keep_workers_off_this_cpu();
  bool yields();

  unsigned size_;
  int niceness_;                         // priority that the workers inherit
  std::atomic<std::int64_t> last_used_;  // [ns] by a thread of no lower priority
  std::mutex owner_;  // held by the caller whose loop is being run
  std::mutex mutex_;
  std::condition_variable wake_;
  std::condition_variable idle_;
  Loop* loop_ = nullptr;
  unsigned long long generation_ = 0;
  unsigned active_ = 0;
  int caller_cpu_ = -1;  // that the workers keep off
  bool stop_ = false;
  std::vector<std::thread> threads_;
};

// The pool all kernels share: SPLATBOT_NUM_THREADS threads, or as many as the process may run on.
std::shared_ptr<ThreadPool> thread_pool();

// True if loops of the calling thread run on it alone: background work leaves the other cores to other threads. False
// in a new thread.
void keep_to_this_thread(bool alone) noexcept;

// Replaces the shared pool; 0 returns to the default. Throws std::invalid_argument above 1024.
void set_num_threads(unsigned threads);

}  // namespace splatbot
