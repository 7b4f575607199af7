#include "memory.h"

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

struct Block {
    void* memory;
    size_t size;

    std::align_val_t alignment() const {
        return std::align_val_t(size < kHugePage ? kLine : kHugePage);
    }
};

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
            block = fresh(size);
        }
        used_ += block.size;
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
        // Least recently freed blocks are released first: their sizes are no longer in use.
        while (used_ + unused_ > most_used_ + most_used_ / 2) {
            unused_ -= free_.front().size;
            ::operator delete(free_.front().memory, free_.front().alignment());
            free_.erase(free_.begin());
        }
    }

  private:
    static Block fresh(size_t size) {
        Block block = {nullptr, size};
        block.memory = ::operator new(size, block.alignment());
#if defined(MADV_HUGEPAGE)
        if (size >= kHugePage) madvise(block.memory, size, MADV_HUGEPAGE);
#endif
        return block;
    }

    std::mutex mutex_;
    std::vector<Block> free_;                  // least recently freed first
    std::unordered_map<void*, size_t> sizes_;  // of the blocks in use
    size_t used_ = 0, unused_ = 0, most_used_ = 0;
};

// Never destroyed: tensors may be freed after static objects.
Pool& pool() {
    static Pool* const one = new Pool;
    return *one;
}

}  // namespace

#if defined(__SANITIZE_ADDRESS__)
// Exactly the requested size, so that the sanitizer detects accesses beyond it.
void* take_memory(size_t bytes) { return ::operator new(bytes, std::align_val_t(kLine)); }
void give_back_memory(void* memory) { ::operator delete(memory, std::align_val_t(kLine)); }
#else
void* take_memory(size_t bytes) { return pool().take(bytes); }
void give_back_memory(void* memory) { pool().give_back(memory); }
#endif

}  // namespace splat
