// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <memory>
#include <mutex>
#include <vector>

namespace splatbot {

// States whose render is done with, kept for the next one: their memory is warm.
template <class State>
class StateStore {
 public:
  StateStore() { idle_.reserve(kMaxIdle); }

  std::unique_ptr<State> take() {
    const std::lock_guard lock(mutex_);
    if (idle_.empty()) {
      return std::make_unique<State>();
    }
    std::unique_ptr<State> state = std::move(idle_.back());
    idle_.pop_back();
    return state;
  }

  void give_back(std::unique_ptr<State> state) noexcept {
    const std::lock_guard lock(mutex_);
    if (idle_.size() < kMaxIdle) {
      idle_.push_back(std::move(state));
    }
  }

  static StateStore& instance() {
    // Never destroyed: states may outlive static objects at the exit of the interpreter.
    static StateStore& store = *std::make_unique<StateStore>().release();
    return store;
  }

 private:
  static constexpr std::size_t kMaxIdle = 2;

  std::mutex mutex_;
  std::vector<std::unique_ptr<State>> idle_;
};

template <class State>
std::shared_ptr<State> new_state() {
  return {StateStore<State>::instance().take().release(),
          [](State* state) { StateStore<State>::instance().give_back(std::unique_ptr<State>(state)); }};
}

}  // namespace splatbot
