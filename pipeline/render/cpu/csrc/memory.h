// Memory that outlives its use: a training step frees what the next one asks for, and touching
// fresh pages of the system each time would cost a fifth of a large step.
#pragma once

#include <cstddef>

namespace splat {

// At least `bytes` bytes of junk on a cache line's boundary, in huge pages where the system has
// them: records and slots are met in any order, each on another small page. From any thread.
void* take_memory(size_t bytes);
void give_back_memory(void* memory);

// An array of junk.
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
