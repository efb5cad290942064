// SPDX-License-Identifier: Apache-2.0
#include "splatbot/threads.hpp"

#include <algorithm>
#include <atomic>
#include <charconv>
#include <chrono>
#include <cstdlib>
#include <exception>
#include <stdexcept>
#include <string>
#include <string_view>

#if defined(__linux__)
#include <pthread.h>
#include <sched.h>
#include <sys/resource.h>
#endif
#if defined(__unix__) || defined(__APPLE__)
#include <unistd.h>
#endif

namespace splatbot {

namespace {

constexpr unsigned kMaxThreads = 1024;
constexpr std::int64_t kYieldedNs = 1'000'000'000;  // how long the pool is left to those of higher priority

thread_local bool this_thread_alone = false;

#if defined(__linux__)
// The CPUs that the process might use at its first call; later the calling thread may itself be restricted.
const cpu_set_t& process_cpus() {
  static const cpu_set_t instance = [] {
    cpu_set_t set;
    CPU_ZERO(&set);
    if (sched_getaffinity(getpid(), sizeof(set), &set) != 0) {
      CPU_ZERO(&set);
    }
    return set;
  }();
  return instance;
}
#endif

// Niceness of the calling thread: on busy cores, threads of lower niceness go first.
int niceness() {
#if defined(__linux__)
  return getpriority(PRIO_PROCESS, 0);
#else
  return 0;
#endif
}

std::int64_t now_ns() {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

unsigned usable_cpus() {
#if defined(__linux__)
  if (CPU_COUNT(&process_cpus()) > 0) {
    return static_cast<unsigned>(CPU_COUNT(&process_cpus()));
  }
#endif
  return std::max(1U, std::thread::hardware_concurrency());
}

unsigned default_threads() {
  const char* text = std::getenv("SPLATBOT_NUM_THREADS");
  if (text == nullptr || *text == '\0') {
    return std::min(usable_cpus(), kMaxThreads);
  }
  const std::string_view view(text);
  unsigned threads = 0;
  const auto [end, error] = std::from_chars(view.data(), view.data() + view.size(), threads);
  if (error != std::errc{} || end != view.data() + view.size() || threads < 1 || threads > kMaxThreads) {
    throw std::invalid_argument("SPLATBOT_NUM_THREADS is '" + std::string(view) + "', must be an integer in 1..1024");
  }
  return threads;
}

long process_id() {
#if defined(__unix__) || defined(__APPLE__)
  return static_cast<long>(::getpid());
#else
  return 0;
#endif
}

struct Shared {
  std::mutex mutex;
  std::shared_ptr<ThreadPool> pool;
  long owner = 0;
};

Shared& shared() {
  // Never destroyed: daemon threads of the interpreter may still call during exit.
  static Shared& instance = *std::make_unique<Shared>().release();
  return instance;
}

}  // namespace

struct ThreadPool::Loop {
  Function function;
  void* context;
  std::size_t count;
  std::atomic<std::size_t> next{0};
  std::atomic<bool> failed{false};
  std::exception_ptr error;

  void run() noexcept {
    for (std::size_t i = next.fetch_add(1, std::memory_order_relaxed); i < count;
         i = next.fetch_add(1, std::memory_order_relaxed)) {
      try {
        function(context, i);
      } catch (...) {
        if (!failed.exchange(true)) {
          error = std::current_exception();
        }
        next.store(count, std::memory_order_relaxed);
      }
    }
  }
};

ThreadPool::ThreadPool(unsigned threads)
    : size_(std::max(1U, threads)), niceness_(niceness()), last_used_(now_ns() - kYieldedNs) {
  threads_.reserve(size_ - 1);
  for (unsigned i = 1; i < size_; ++i) {
    threads_.emplace_back([this] { work(); });
  }
}

ThreadPool::~ThreadPool() {
  {
    const std::lock_guard lock(mutex_);
    stop_ = true;
  }
  wake_.notify_all();
  for (std::thread& thread : threads_) {
    thread.join();
  }
}

void ThreadPool::run_erased(std::size_t count, Function function, void* context) {
  std::unique_lock owner(owner_, std::defer_lock);
  if (this_thread_alone || threads_.empty() || count < 2 || yields() || !owner.try_lock()) {
    for (std::size_t i = 0; i < count; ++i) {
      function(context, i);
    }
    return;
  }
  keep_workers_off_this_cpu();
  Loop loop{.function = function, .context = context, .count = count, .error = nullptr};
  {
    const std::lock_guard lock(mutex_);
    loop_ = &loop;
    ++generation_;
  }
  wake_.notify_all();
  loop.run();
  std::unique_lock lock(mutex_);
  loop_ = nullptr;  // threads that wake late find nothing to do
  idle_.wait(lock, [this] { return active_ == 0; });
  if (loop.error) {
    std::rethrow_exception(loop.error);
  }
}

// True if the calling thread yields the workers, which have the priority of the pool's creator, to other threads.
bool ThreadPool::yields() {
  thread_local const int mine = niceness();
  if (mine <= niceness_) {
    last_used_.store(now_ns(), std::memory_order_relaxed);
    return false;
  }
  return now_ns() - last_used_.load(std::memory_order_relaxed) < kYieldedNs;
}

// A scheduler that wakes a sleeping thread likes to put it where the waker runs. With the waker busy for the whole
// loop, that worker would wait until the loop is over: two threads would be no faster than one.
void ThreadPool::keep_workers_off_this_cpu() {
#if defined(__linux__)
  const int cpu = sched_getcpu();
  if (cpu < 0 || cpu == caller_cpu_ || size_ > usable_cpus()) {
    return;
  }
  cpu_set_t others = process_cpus();
  CPU_CLR(static_cast<std::size_t>(cpu), &others);
  for (std::thread& thread : threads_) {
    // Refused on some systems; then the scheduler decides.
    static_cast<void>(pthread_setaffinity_np(thread.native_handle(), sizeof(others), &others));
  }
  caller_cpu_ = cpu;
#endif
}

void ThreadPool::work() {
  unsigned long long seen = 0;
  std::unique_lock lock(mutex_);
  while (true) {
    wake_.wait(lock, [&] { return stop_ || generation_ != seen; });
    if (stop_) {
      return;
    }
    seen = generation_;
    Loop* loop = loop_;
    if (loop == nullptr) {
      continue;
    }
    ++active_;
    lock.unlock();
    loop->run();
    lock.lock();
    if (--active_ == 0) {
      idle_.notify_one();
    }
  }
}

std::shared_ptr<ThreadPool> thread_pool() {
  Shared& s = shared();
  const std::lock_guard lock(s.mutex);
  if (s.pool && s.owner != process_id()) {
    // After fork() the threads exist in the parent only; the pool cannot be joined here, so it is let go.
    static_cast<void>(*std::make_unique<std::shared_ptr<ThreadPool>>(std::move(s.pool)).release());
    s.pool = nullptr;
  }
  if (!s.pool) {
    s.pool = std::make_shared<ThreadPool>(default_threads());
    s.owner = process_id();
  }
  return s.pool;
}

void keep_to_this_thread(bool alone) noexcept { this_thread_alone = alone; }

void set_num_threads(unsigned threads) {
  if (threads > kMaxThreads) {
    throw std::invalid_argument("the number of threads must be in 0..1024");
  }
  const unsigned wanted = threads == 0 ? default_threads() : threads;
  auto pool = std::make_shared<ThreadPool>(wanted);
  Shared& s = shared();
  const std::lock_guard lock(s.mutex);
  s.pool.swap(pool);
  s.owner = process_id();
}

}  // namespace splatbot
