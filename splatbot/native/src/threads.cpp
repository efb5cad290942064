// SPDX-License-Identifier: Apache-2.0
#include "splatbot/threads.hpp"

#include <algorithm>
#include <atomic>
#include <charconv>
#include <cstdlib>
#include <exception>
#include <stdexcept>
#include <string>
#include <string_view>

#if defined(__linux__)
#include <sched.h>
#endif
#if defined(__unix__) || defined(__APPLE__)
#include <unistd.h>
#endif

namespace splatbot {

namespace {

constexpr unsigned kMaxThreads = 1024;

unsigned usable_cpus() {
#if defined(__linux__)
  cpu_set_t set;
  if (sched_getaffinity(0, sizeof(set), &set) == 0) {
    return std::max(1, CPU_COUNT(&set));
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

ThreadPool::ThreadPool(unsigned threads) : size_(std::max(1U, threads)) {
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
  const std::unique_lock owner(owner_, std::try_to_lock);
  if (!owner.owns_lock() || threads_.empty() || count < 2) {
    for (std::size_t i = 0; i < count; ++i) {
      function(context, i);
    }
    return;
  }
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
