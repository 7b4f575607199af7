// Runs every kernel without torch, for builds under sanitizers and for other instruction sets.
//
//   driver               runs ordinary and arbitrary scenes; prints errors and exits with 1, or
//                        prints "clean"
//   driver OUTPUT        writes the image and gradients of an ordinary scene
//   driver INPUT OUTPUT  reads a scene and a view, writes the kernels' results

#include <cmath>
#include <cstdio>
#include <cstring>
#include <limits>
#include <memory>
#include <random>
#include <utility>

#include "adam.h"
#include "bin.h"
#include "blend.h"
#include "loss.h"
#include "project.h"
#include "update.h"

using namespace splat;

namespace {

// A heap array of exactly its size, so that the sanitizer detects accesses beyond it.
template <class T>
struct Array {
    size_t size;
    std::unique_ptr<T[]> data;
    explicit Array(size_t n) : size(n), data(new T[n]()) {}
    T* get() { return data.get(); }
    T& operator[](size_t i) { return data[i]; }
};

struct Scene {
    int64_t count;
    int degree;
    Array<float> means, log_scales, quats, opacity_logits, sh;
    Scene(int64_t n, int degree)
        : count(n),
          degree(degree),
          means(3 * n),
          log_scales(3 * n),
          quats(4 * n),
          opacity_logits(n),
          sh(3 * (degree + 1) * (degree + 1) * n) {}
    Array<float>* fields[5] = {&means, &log_scales, &quats, &opacity_logits, &sh};
};

// Uniform in [-1, 1), the same with every standard library.
float uniform(std::mt19937& random) { return float(random() >> 8) * (2.0f / 16777216.0f) - 1.0f; }

Scene ordinary(std::mt19937& random, int64_t count, int degree) {
    Scene s(count, degree);
    for (int64_t i = 0; i < count; i++) {
        for (int k = 0; k < 3; k++) {
            s.means[3 * i + k] = 2 * uniform(random) + (k == 2 ? 4.0f : 0.0f);
            s.log_scales[3 * i + k] = -2.5f + uniform(random);
        }
        for (int k = 0; k < 4; k++) s.quats[4 * i + k] = uniform(random) + (k == 0 ? 1.01f : 0);
        s.opacity_logits[i] = 3 * uniform(random);
    }
    for (size_t i = 0; i < s.sh.size; i++) s.sh[i] = 0.5f * uniform(random);
    return s;
}

template <class T>
void expect_finite(Array<T>& values, const char* what) {
    for (size_t i = 0; i < values.size; i++)
        if (!std::isfinite(values[i])) {
            std::printf("%s[%zu] = %g\n", what, i, double(values[i]));
            std::exit(1);
        }
}

void set_slopes(View& view) {
    const double margin_x = 0.15 * view.width / view.fx, margin_y = 0.15 * view.height / view.fy;
    view.min_u = -view.cx / view.fx - margin_x;
    view.max_u = (view.width - view.cx) / view.fx + margin_x;
    view.min_v = -view.cy / view.fy - margin_y;
    view.max_v = (view.height - view.cy) / view.fy + margin_y;
}

// The kernels over one view, with arrays of exactly the sizes that they need.
struct Pass {
    const View& view;
    const int threads;
    const float* background;
    const Gaussians in;
    const size_t n = size_t(in.count), pixels = size_t(view.width * view.height);
    const size_t sh = size_t(3 * in.count * in.sh_coefficients);
    Array<Record> records{n};
    Array<Slots> slots{n};
    Array<Entry> entries{0};
    Array<int64_t> begin{size_t(view.tiles() + 1)};
    Array<int32_t> block_end{size_t(kBlocks * view.tiles())};
    Array<float> radii{n}, color{3 * pixels}, alpha{pixels}, depth{pixels}, median{pixels};
    Array<float> d_means{3 * n}, d_scales{3 * n}, d_quats{4 * n}, d_opacity{n}, d_sh{sh};
    Array<float> d_means2d{2 * n}, d_colors{3 * n}, d_loss{3 * pixels};
    Array<double> d_camera{kCameraParameters};

    Pass(Scene& s, const View& view, int threads, const float* background)
        : view(view), threads(threads), background(background), in(gaussians(s)) {}

    static Gaussians gaussians(Scene& s) {
        return {s.count,       (s.degree + 1) * (s.degree + 1), s.means.get(), s.log_scales.get(),
                s.quats.get(), s.opacity_logits.get(),          s.sh.get()};
    }

    // Returns false if there are too many pairs.
    bool forward() {
        project_view(in, view, threads, records.get(), radii.get());
        Binner binner;
        if (!binner.find(records.get(), radii.get(), in.count, view, threads, slots.get()))
            return false;
        entries = Array<Entry>(size_t(binner.intersections()));
        binner.write(entries.get(), begin.get());
        blend(records.get(), {entries.get(), begin.get()}, view, background, threads, color.get(),
              alpha.get(), block_end.get());
        blend_depth(records.get(), {entries.get(), begin.get()}, view, threads, depth.get(),
                    median.get());
        return true;
    }
    Array<float> slot_gradients(const float* d_color, const float* d_alpha, const float* d_depth) {
        Array<float> found(entries.size * kSlotFloats);
        blend_backward(
            records.get(), {entries.get(), begin.get()}, view,
            {color.get(), alpha.get(), depth.get(), d_color, d_alpha, d_depth, background},
            block_end.get(), threads, found.get());
        return found;
    }
    void backward(const float* d_color, const float* d_alpha, const float* d_depth,
                  bool optional_outputs, const ShAdam* sh_adam) {
        project_view_backward(
            in, view, threads, records.get(), radii.get(), slots.get(),
            slot_gradients(d_color, d_alpha, d_depth).get(),
            {d_means.get(), d_scales.get(), d_quats.get(), d_opacity.get(), d_means2d.get(),
             sh_adam ? nullptr : d_sh.get(), optional_outputs ? d_colors.get() : nullptr},
            optional_outputs ? d_camera.get() : nullptr, sh_adam, nullptr);
    }
    void update(Scene& s, bool optional_outputs, const ShAdam& sh_adam) {
        Array<float> moments[] = {Array<float>(3 * n), Array<float>(3 * n), Array<float>(3 * n),
                                  Array<float>(3 * n), Array<float>(3 * n), Array<float>(3 * n),
                                  Array<float>(n),     Array<float>(n)};
        Array<float> gradient_sum(n), seen(n);
        const double rates[] = {1e-2, 1e-3};
        const AdamSettings one = {rates, 1, 0.9, 0.999, 1e-15, 1},
                           two = {rates, 2, 0.9, 0.999, 1e-15, 1};
        const auto moment = [&](int k) { return moments[k].get(); };
        const GaussianUpdate update = {s.means.get(),
                                       s.quats.get(),
                                       s.log_scales.get(),
                                       s.opacity_logits.get(),
                                       {moment(0), moment(1), moment(2), moment(3)},
                                       {moment(4), moment(5)},
                                       {moment(6), moment(7)},
                                       two,
                                       one,
                                       one,
                                       optional_outputs ? gradient_sum.get() : nullptr,
                                       optional_outputs ? seen.get() : nullptr,
                                       radii.get(),
                                       0.5 * double(view.width),
                                       0.5 * double(view.height)};
        project_view_backward(in, view, threads, records.get(), radii.get(), slots.get(),
                              slot_gradients(d_loss.get(), nullptr, nullptr).get(),
                              {nullptr, nullptr, nullptr, nullptr, nullptr, nullptr,
                               optional_outputs ? d_colors.get() : nullptr},
                              optional_outputs ? d_camera.get() : nullptr, &sh_adam, &update);
        for (Array<float>& each : moments) expect_finite(each, "moments of an update");
        expect_finite(gradient_sum, "gradient_sum");
    }
    void loss(const Array<float>& target, const uint8_t* mask, const float* factor = nullptr,
              bool factor_is_image = false) {
        l1_ssim({view.width, view.height, color.get(), factor, factor_is_image, target.data.get(),
                 nullptr, mask},
                {0.2, 2.5}, threads, d_loss.get());
    }
};

// Runs all kernels over one view; writes the image and the gradients to `out`, if any.
void run(Scene& s, int64_t width, int64_t height, bool antialias, int threads, std::FILE* out) {
    View view = {width,
                 height,
                 0.9 * width,
                 0.9 * width,
                 0.48 * width,
                 0.53 * height,
                 {1, 0, 0, 0, 1, 0, 0, 0, 1},
                 {0.1, -0.1, 0.2},
                 0.01};
    view.antialias = antialias, view.sh_degree = s.degree;
    set_slopes(view);
    const float background[3] = {0.1f, 0.5f, 0.9f};
    Pass p(s, view, threads, background);
    if (!p.forward()) return;
    const size_t n = p.n;
    Array<float> target(3 * p.pixels);
    Array<uint8_t> mask(p.pixels);
    for (size_t i = 0; i < target.size; i++) target[i] = float(i % 97) / 97;
    for (size_t i = 0; i < mask.size; i++) mask[i] = i % 5 == 0;
    p.loss(target, mask.get());
    p.loss(target, mask.get(), background);
    p.loss(target, nullptr, target.get(), true);
    p.loss(target, nullptr);
    p.backward(p.d_loss.get(), p.median.get(), p.alpha.get(), true, nullptr);
    p.backward(p.d_loss.get(), nullptr, nullptr, false, nullptr);
    Array<uint16_t> first(s.sh.size);
    Array<float> second(s.sh.size / 3), m(s.sh.size), v(s.sh.size), param(s.sh.size);
    Array<int32_t> last(n);
    const ShAdam sh_adam({s.sh.get(), first.get(), second.get(), last.get()},
                         {1e-2, 1e-3, 0.9, 0.999, 1e-15, 9});
    p.backward(p.d_loss.get(), nullptr, nullptr, false, &sh_adam);
    expect_finite(p.d_camera, "d_camera");
    expect_finite(second, "second moments");
    for (size_t i = 0; i < first.size; i++) {
        const uint32_t bits = uint32_t(first[i]) << 16;
        std::memcpy(&m[i], &bits, sizeof(bits));
    }
    expect_finite(m, "first moments");
    const double rate = 1e-2;
    adam_step(param.get(), p.d_sh.get(), m.get(), v.get(), int64_t(s.sh.size),
              {&rate, 1, 0.9, 0.999, 1e-15, 1}, threads);
    // Steps from zero; invalid quaternions and Gaussians that are not drawn are not updated, so NaN
    // inputs stay NaN.
    Array<float> moved(3 * n), turned(4 * n), f0(3 * n), f1(3 * n), f2(3 * n), f3(3 * n);
    for (size_t i = 0; i < turned.size; i++)
        turned[i] = std::isfinite(s.quats[i]) ? s.quats[i] : 0.0f;
    const double rates[] = {1e-2, 1e-3};
    frame_adam(moved.get(), turned.get(), s.log_scales.get(), p.d_means.get(), p.d_quats.get(),
               {f0.get(), f1.get(), f2.get(), f3.get()}, n, {rates, 2, 0.9, 0.999, 1e-15, 1},
               threads);
    for (Array<float>* moments : {&f0, &f1, &f2, &f3}) expect_finite(*moments, "frame moments");
    const std::pair<const char*, Array<float>*> results[] = {
        {"color", &p.color},       {"alpha", &p.alpha},         {"depth", &p.depth},
        {"median", &p.median},     {"d_color", &p.d_loss},      {"d_means", &p.d_means},
        {"d_scales", &p.d_scales}, {"d_quats", &p.d_quats},     {"d_opacity", &p.d_opacity},
        {"d_sh", &p.d_sh},         {"d_means2d", &p.d_means2d}, {"param", &param},
        {"moved", &moved},         {"turned", &turned}};
    for (const auto& [name, values] : results) {
        expect_finite(*values, name);
        if (out) std::fwrite(values->get(), sizeof(float), values->size, out);
    }
    for (const bool optional_outputs : {true, false}) p.update(s, optional_outputs, sh_adam);
}

// The file that test_targets.py writes: these, then the Gaussians' fields, the gradients of color,
// alpha and depth, and the target of the loss.
struct Header {
    int64_t count, degree, width, height, antialias, threads;
    double fx, fy, cx, cy, rotation[9], translation[3], near, background[3];
};

template <class T>
void read(std::FILE* in, T* to, size_t count) {
    if (std::fread(to, sizeof(T), count, in) == count) return;
    std::puts("the input ends too early");
    std::exit(2);
}

// Renders the view of a scene file.
int run_file(const char* input, const char* output) {
    std::FILE *in = std::fopen(input, "rb"), *out = std::fopen(output, "wb");
    if (!in || !out) return 2;
    Header h;
    read(in, &h, 1);
    Scene s(h.count, int(h.degree));
    for (Array<float>* field : s.fields) read(in, field->get(), field->size);
    const size_t pixels = size_t(h.width * h.height);
    Array<float> d_color(3 * pixels), d_alpha(pixels), d_depth(pixels), target(3 * pixels);
    for (Array<float>* image : {&d_color, &d_alpha, &d_depth, &target})
        read(in, image->get(), image->size);
    std::fclose(in);

    View view = {h.width, h.height, h.fx, h.fy, h.cx, h.cy, {}, {}, h.near};
    view.antialias = h.antialias != 0, view.sh_degree = int(h.degree);
    std::memcpy(view.rotation, h.rotation, sizeof(view.rotation));
    std::memcpy(view.translation, h.translation, sizeof(view.translation));
    set_slopes(view);
    const int threads = int(h.threads);
    const float background[3] = {float(h.background[0]), float(h.background[1]),
                                 float(h.background[2])};
    Pass p(s, view, threads, background);
    if (!p.forward()) return 2;
    p.backward(d_color.get(), d_alpha.get(), d_depth.get(), true, nullptr);
    p.loss(target, nullptr);
    Array<float> m(s.sh.size), v(s.sh.size);
    const double rate = 1e-2;
    adam_step(s.sh.get(), p.d_sh.get(), m.get(), v.get(), int64_t(s.sh.size),
              {&rate, 1, 0.9, 0.999, 1e-15, 1}, threads);
    for (Array<float>* result :
         {&p.color, &p.alpha, &p.depth, &p.median, &p.radii, &p.d_means, &p.d_scales, &p.d_quats,
          &p.d_opacity, &p.d_sh, &p.d_means2d, &p.d_loss, &s.sh})
        std::fwrite(result->get(), sizeof(float), result->size, out);
    std::fwrite(p.d_camera.get(), sizeof(double), p.d_camera.size, out);
    return std::fclose(out) ? 2 : 0;
}

}  // namespace

int main(int argc, char** argv) {
    if (argc > 2) return run_file(argv[1], argv[2]);
    std::mt19937 random(7);
    if (argc > 1) {
        std::FILE* out = std::fopen(argv[1], "wb");
        if (!out) return 2;
        Scene scene = ordinary(random, 800, 3);
        run(scene, 97, 61, false, 2, out);
        std::fclose(out);
        return 0;
    }
    constexpr float infinity = std::numeric_limits<float>::infinity();
    const float extreme[] = {std::nanf(""), infinity, -infinity, 0,     1e-45f, 1e38f,
                             -1e38f,        3.4e38f,  1e-12f,    1e12f, 88,     -88,
                             27.6f,         -27.6f,   12,        100};
    const int64_t sizes[][2] = {{1, 1}, {2, 3}, {17, 31}, {16, 16}, {53, 7}, {5, 90}};
    for (int round = 0; round < 300; round++) {
        Scene scene = ordinary(random, random() % 40, int(random() % 4));
        for (int hit = int(random() % 16); hit > 0; hit--) {
            Array<float>& field = *scene.fields[random() % 5];
            const float value = extreme[random() % 16];
            if (field.size) field[random() % field.size] = value;
        }
        const int64_t* size = sizes[random() % 6];
        run(scene, size[0], size[1], random() % 2, 1 + int(random() % 3), nullptr);
    }
    std::puts("clean");
}
