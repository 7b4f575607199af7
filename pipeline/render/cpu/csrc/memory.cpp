#include "memory.h"

#include <algorithm>
#include <cstdint>
#include <mutex>
#include <new>
#include <unordered_map>
#include <vector>
#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace splat {
namespace {

constexpr size_t kHugePage = size_t(2) << 20, kLine = 64;
// Unused memory is limited by the peak of use over the last one or two periods of so many
// allocations, which are some dozens of steps.
constexpr size_t kPeriod = 1024;

struct Block {
    void* memory;
    size_t size;
};

#if defined(__linux__)
// Pages of their own: on the heap, large blocks that are freed leave gaps, which smaller ones
// split.
void* new_pages(size_t size) {
    const size_t mapped = size + kHugePage;
    void* const found =
        mmap(nullptr, mapped, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (found == MAP_FAILED) throw std::bad_alloc();
    char* const first = static_cast<char*>(found);
    const size_t before = (kHugePage - reinterpret_cast<uintptr_t>(first) % kHugePage) % kHugePage;
    if (before) munmap(first, before);
    if (before < kHugePage) munmap(first + before + size, kHugePage - before);
#if defined(MADV_HUGEPAGE)
    madvise(first + before, size, MADV_HUGEPAGE);
#endif
    return first + before;
}
#endif

Block new_block(size_t size) {
#if defined(__linux__)
    if (size >= kHugePage) return {new_pages(size), size};
#endif
    return {::operator new(size, std::align_val_t(kLine)), size};
}

void free_block(const Block& block) {
#if defined(__linux__)
    if (block.size >= kHugePage) {
        munmap(block.memory, block.size);
        return;
    }
#endif
    ::operator delete(block.memory, std::align_val_t(kLine));
}

class Pool {
  public:
    void* take(size_t bytes) {
        const size_t unit = bytes < kHugePage ? 4096 : kHugePage;
        const size_t size = (bytes + unit) / unit * unit;
        const std::lock_guard<std::mutex> lock(mutex_);
        // The smallest block that fits, unless it is much larger.
        size_t best = free_.size();
        for (size_t i = 0; i < free_.size(); i++)
            if (free_[i].size >= size && free_[i].size <= 2 * size &&
                (best == free_.size() || free_[i].size < free_[best].size))
                best = i;
        Block block;
        if (best < free_.size()) {
            block = free_[best];
            free_.erase(free_.begin() + best);
            unused_ -= block.size;
        } else {
            if (little_) limit_unused(size);
            block = new_block(size);
        }
        used_ += block.size;
        if (++taken_ % kPeriod == 0) {
            earlier_most_ = most_used_;
            most_used_ = 0;
        }
        most_used_ = used_ > most_used_ ? used_ : most_used_;
        sizes_[block.memory] = block.size;
        return block.memory;
    }

    void give_back(void* memory) {
        const std::lock_guard<std::mutex> lock(mutex_);
        const auto found = sizes_.find(memory);
        free_.push_back({memory, found->second});
        used_ -= found->second;
        unused_ += found->second;
        sizes_.erase(found);
        limit_unused(0);
    }

    void release_unused() {
        const std::lock_guard<std::mutex> lock(mutex_);
        while (!free_.empty()) release_one();
        most_used_ = earlier_most_ = used_;
    }

    void save(bool little) {
        const std::lock_guard<std::mutex> lock(mutex_);
        little_ = little;
        limit_unused(0);
    }

  private:
    // Limits unused memory, with `more` bytes that are about to be used. The least recently freed
    // blocks are released first: their sizes are no longer in use.
    void limit_unused(size_t more) {
        const size_t most = std::max({most_used_, earlier_most_, used_ + more});
        const size_t kept = most / (little_ ? 8 : 2);
        while (!free_.empty() && used_ + more + unused_ > most + kept) release_one();
    }

    void release_one() {
        unused_ -= free_.front().size;
        free_block(free_.front());
        free_.erase(free_.begin());
    }

    std::mutex mutex_;
    std::vector<Block> free_;                  // least recently freed first
    std::unordered_map<void*, size_t> sizes_;  // of the blocks in use
    size_t used_ = 0, unused_ = 0, most_used_ = 0, earlier_most_ = 0, taken_ = 0;
    bool little_ = false;
};

// Never destroyed: tensors may be freed after static objects.
Pool& pool() {
    static Pool* const one = new Pool;
    return *one;
}

}  // namespace

void release_unused_memory() { pool().release_unused(); }
void save_memory(bool little) { pool().save(little); }

#if defined(__SANITIZE_ADDRESS__)
// Exactly the requested size, so that the sanitizer detects accesses beyond it.
void* take_memory(size_t bytes) { return ::operator new(bytes, std::align_val_t(kLine)); }
void give_back_memory(void* memory) { ::operator delete(memory, std::align_val_t(kLine)); }
#else
void* take_memory(size_t bytes) { return pool().take(bytes); }
void give_back_memory(void* memory) { pool().give_back(memory); }
#endif

}  // namespace splat
