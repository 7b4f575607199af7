// A memory pool: each training step frees what the next one allocates, and page faults of new
// memory would take a considerable share of a step.
#pragma once

#include <cstddef>

namespace splat {

// At least `bytes` uninitialised bytes, aligned to a cache line, in huge pages if available:
// records and slots are accessed in random order. Thread-safe.
void* take_memory(size_t bytes);
void give_back_memory(void* memory);

// Returns to the system the memory that is kept for later calls.
void release_unused_memory();
// Chooses whether to keep little memory for later calls, at the cost of more page faults.
void save_memory(bool little);

// An uninitialised array.
template <class T>
class Scratch {
  public:
    Scratch() = default;
    explicit Scratch(size_t count) : data_(static_cast<T*>(take_memory(count * sizeof(T)))) {}
    Scratch(Scratch&& other) noexcept : data_(other.data_) { other.data_ = nullptr; }
    Scratch& operator=(Scratch&& other) noexcept {
        T* const mine = data_;
        data_ = other.data_;
        other.data_ = mine;
        return *this;
    }
    ~Scratch() {
        if (data_) give_back_memory(data_);
    }
    T* get() const { return data_; }
    T& operator[](size_t i) const { return data_[i]; }

  private:
    T* data_ = nullptr;
};

}  // namespace splat
