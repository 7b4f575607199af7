// Runs the matcher without Python, for an emulated processor.
// nearest_driver N M INPUT OUTPUT: INPUT contains N + M descriptors; OUTPUT receives six arrays.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <vector>

extern "C" void nearest(const uint8_t*, int32_t, const uint8_t*, int32_t, int32_t*, int32_t*,
                        int32_t*, int32_t*, int32_t*, int32_t*);

int main(int, char** arguments) {
    const int n = std::atoi(arguments[1]), m = std::atoi(arguments[2]);
    std::vector<uint8_t> input(size_t(n + m) * 128);
    std::vector<int32_t> output(size_t(n + m) * 3);
    FILE* from = std::fopen(arguments[3], "rb");
    if (!from || std::fread(input.data(), 1, input.size(), from) != input.size()) return 1;
    int32_t *a = output.data(), *b = a + 3 * n;
    nearest(input.data(), n, input.data() + size_t(n) * 128, m, a, a + n, a + 2 * n, b, b + m,
            b + 2 * m);
    FILE* to = std::fopen(arguments[4], "wb");
    if (!to || std::fwrite(output.data(), 4, output.size(), to) != output.size()) return 1;
    return std::fclose(to);
}
