// The kernels as torch.ops.splatmake.*, on torch's stable ABI. Shapes are checked in checks.py,
// types here by the typed data pointers.

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <optional>
#include <tuple>
#include <vector>

#include "adam.h"
#include "bin.h"
#include "blend.h"
#include "loss.h"
#include "memory.h"
#include "project.h"
#include "rows.h"
#include "step.h"
#include "surroundings.h"
#include "threads.h"
#include "update.h"

namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using OptionalTensor = std::optional<Tensor>;

const float* floats(const Tensor& t) { return t.const_data_ptr<float>(); }
const float* floats(const OptionalTensor& t) { return t ? floats(*t) : nullptr; }
float* mutable_floats(const Tensor& t) { return t.mutable_data_ptr<float>(); }

// An uninitialised tensor in memory that is reused.
Tensor new_tensor(const std::vector<int64_t>& shape, ScalarType type, size_t element_size) {
    std::vector<int64_t> strides(shape.size());
    int64_t count = 1;
    for (size_t i = shape.size(); i-- > 0; count *= shape[i]) strides[i] = count;
    return torch::stable::from_blob(splat::take_memory(size_t(count) * element_size), shape,
                                    strides, {torch::headeronly::DeviceType::CPU}, type,
                                    splat::give_back_memory);
}
template <class T>
Tensor new_tensor(const std::vector<int64_t>& shape, ScalarType type) {
    return new_tensor(shape, type, sizeof(T));
}
Tensor new_floats(const std::vector<int64_t>& shape) {
    return new_tensor<float>(shape, ScalarType::Float);
}

// view: float64, in the order of `_pack_view` in backend.py.
splat::View view_from(const Tensor& packed) {
    const double* v = packed.const_data_ptr<double>();
    splat::View view = {};
    view.fx = v[0], view.fy = v[1], view.cx = v[2], view.cy = v[3];
    for (int i = 0; i < 9; i++) view.rotation[i] = v[4 + i];
    for (int i = 0; i < 3; i++) view.translation[i] = v[13 + i];
    view.near = v[16];
    view.min_u = v[17], view.max_u = v[18], view.min_v = v[19], view.max_v = v[20];
    view.width = int64_t(v[21]), view.height = int64_t(v[22]);
    view.sh_degree = int(v[23]);
    view.antialias = v[24] != 0, view.clamp_color_gradient = v[25] != 0;
    return view;
}
struct Background {
    float rgb[3];

    explicit Background(const Tensor& view) {
        const double* v = view.const_data_ptr<double>();
        for (int c = 0; c < 3; c++) rgb[c] = float(v[26 + c]);
    }
};

// adam: float64, the step, beta1, beta2, epsilon and the learning rates.
splat::AdamSettings settings_from(const Tensor& adam) {
    const double* a = adam.const_data_ptr<double>();
    return {a + 4, adam.numel() - 4, a[1], a[2], a[3], int64_t(a[0])};
}

splat::Gaussians gaussians_from(const Tensor& means, const Tensor& log_scales, const Tensor& quats,
                                const Tensor& opacity_logits, const Tensor& sh) {
    return {means.size(0),          sh.size(1), floats(means), floats(log_scales), floats(quats),
            floats(opacity_logits), floats(sh)};
}

const splat::Record* records_from(const Tensor& t) {
    return reinterpret_cast<const splat::Record*>(floats(t));
}

splat::Pairs pairs_from(const Tensor& entries, const Tensor& tile_begin) {
    return {reinterpret_cast<const splat::Entry*>(entries.const_data_ptr<int32_t>()),
            tile_begin.const_data_ptr<int64_t>()};
}

// (N, 16) records, (N) radii, number of visible and of dropped Gaussians
std::tuple<Tensor, Tensor, int64_t, int64_t> project(const Tensor& means, const Tensor& log_scales,
                                                     const Tensor& quats,
                                                     const Tensor& opacity_logits, const Tensor& sh,
                                                     const Tensor& view, int64_t threads) {
    const int64_t n = means.size(0);
    Tensor records = new_floats({n, int64_t(sizeof(splat::Record) / sizeof(float))});
    Tensor radii = new_floats({n});
    const splat::ProjectCounts counts = splat::project_view(
        gaussians_from(means, log_scales, quats, opacity_logits, sh), view_from(view), int(threads),
        reinterpret_cast<splat::Record*>(mutable_floats(records)), mutable_floats(radii));
    return {records, radii, counts.visible, counts.dropped};
}

// (M, 3) entries, (tiles + 1) tile_begin, (N, 2) slots, and whether the pairs fit
std::tuple<Tensor, Tensor, Tensor, bool> bin(const Tensor& records, const Tensor& radii,
                                             const Tensor& view, int64_t threads) {
    const splat::View v = view_from(view);
    Tensor slots = new_tensor<int32_t>({records.size(0), 2}, ScalarType::Int);
    splat::Binner binner;
    const bool fits =
        binner.find(records_from(records), floats(radii), records.size(0), v, int(threads),
                    reinterpret_cast<splat::Slots*>(slots.mutable_data_ptr<int32_t>()));
    Tensor entries = new_tensor<int32_t>({fits ? binner.intersections() : 0, 3}, ScalarType::Int);
    Tensor tile_begin = new_tensor<int64_t>({v.tiles() + 1}, ScalarType::Long);
    if (fits)
        binner.write(reinterpret_cast<splat::Entry*>(entries.mutable_data_ptr<int32_t>()),
                     tile_begin.mutable_data_ptr<int64_t>());
    return {entries, tile_begin, slots, fits};
}

// (H, W, 3) color, (H, W) alpha, (tiles, kBlocks) block_end
std::tuple<Tensor, Tensor, Tensor> blend(const Tensor& records, const Tensor& entries,
                                         const Tensor& tile_begin, const Tensor& view,
                                         int64_t threads) {
    const splat::View v = view_from(view);
    Tensor color = new_floats({v.height, v.width, 3}), alpha = new_floats({v.height, v.width});
    Tensor block_end = new_tensor<int32_t>({v.tiles(), splat::kBlocks}, ScalarType::Int);
    splat::blend(records_from(records), pairs_from(entries, tile_begin), v, Background(view).rgb,
                 int(threads), mutable_floats(color), mutable_floats(alpha),
                 block_end.mutable_data_ptr<int32_t>());
    return {color, alpha, block_end};
}

// (H, W) depth, (H, W) median depth
std::tuple<Tensor, Tensor> blend_depth(const Tensor& records, const Tensor& entries,
                                       const Tensor& tile_begin, const Tensor& view,
                                       int64_t threads) {
    const splat::View v = view_from(view);
    Tensor depth = new_floats({v.height, v.width}), median = new_floats({v.height, v.width});
    splat::blend_depth(records_from(records), pairs_from(entries, tile_begin), v, int(threads),
                       mutable_floats(depth), mutable_floats(median));
    return {depth, median};
}

// (M, 16) gradient slots
Tensor blend_backward(const Tensor& records, const Tensor& entries, const Tensor& tile_begin,
                      const Tensor& block_end, const Tensor& view, const Tensor& color,
                      const Tensor& alpha, OptionalTensor depth, const Tensor& d_color,
                      OptionalTensor d_alpha, OptionalTensor d_depth, int64_t threads) {
    Tensor slots = new_floats({entries.size(0), splat::kSlotFloats});
    const Background background(view);
    splat::blend_backward(records_from(records), pairs_from(entries, tile_begin), view_from(view),
                          {floats(color), floats(alpha), floats(depth), floats(d_color),
                           floats(d_alpha), floats(d_depth), background.rgb},
                          block_end.const_data_ptr<int32_t>(), int(threads), mutable_floats(slots));
    return slots;
}

splat::ShAdam sh_adam_from(const Tensor& sh, const Tensor& exp_avg, const Tensor& exp_avg_sq,
                           const Tensor& last, const Tensor& adam) {
    const splat::AdamSettings s = settings_from(adam);
    return {{mutable_floats(sh), static_cast<uint16_t*>(exp_avg.mutable_data_ptr()),
             mutable_floats(exp_avg_sq), last.mutable_data_ptr<int32_t>()},
            {s.rates[0], s.rates[1], s.beta1, s.beta2, s.eps, s.step}};
}

const splat::Slots* slots_from(const Tensor& t) {
    return reinterpret_cast<const splat::Slots*>(t.const_data_ptr<int32_t>());
}

// The gradients of the camera's parameters, float64; no rows if not requested.
Tensor new_camera_gradients(bool requested) {
    return new_tensor<double>({requested ? splat::kCameraParameters : 0}, ScalarType::Double);
}
double* doubles_or_null(const Tensor& t) {
    return t.numel() ? t.mutable_data_ptr<double>() : nullptr;
}

// Gradients of means, log_scales, quats, opacity_logits, sh, means2d, colours and the camera's
// parameters; the last two have no rows if not requested. With exp_avg, exp_avg_sq, last and adam,
// sh is updated in place and its gradient has no rows.
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> project_backward(
    const Tensor& means, const Tensor& log_scales, const Tensor& quats,
    const Tensor& opacity_logits, const Tensor& sh, const Tensor& view, const Tensor& records,
    const Tensor& radii, const Tensor& slots, const Tensor& slot_gradients, bool colors,
    bool camera, OptionalTensor exp_avg, OptionalTensor exp_avg_sq, OptionalTensor last,
    OptionalTensor adam, int64_t threads) {
    const int64_t n = means.size(0);
    std::optional<splat::ShAdam> sh_adam;
    if (adam) sh_adam.emplace(sh_adam_from(sh, *exp_avg, *exp_avg_sq, *last, *adam));
    Tensor d_means = new_floats({n, 3}), d_scales = new_floats({n, 3}),
           d_quats = new_floats({n, 4});
    Tensor d_opacity = new_floats({n}), d_sh = new_floats({adam ? 0 : n, sh.size(1), 3});
    Tensor d_means2d = new_floats({n, 2}), d_colors = new_floats({colors ? n : 0, 3});
    Tensor d_camera = new_camera_gradients(camera);
    splat::project_view_backward(
        gaussians_from(means, log_scales, quats, opacity_logits, sh), view_from(view), int(threads),
        records_from(records), floats(radii), slots_from(slots), floats(slot_gradients),
        {mutable_floats(d_means), mutable_floats(d_scales), mutable_floats(d_quats),
         mutable_floats(d_opacity), mutable_floats(d_means2d),
         adam ? nullptr : mutable_floats(d_sh), colors ? mutable_floats(d_colors) : nullptr},
        doubles_or_null(d_camera), adam ? &*sh_adam : nullptr, nullptr);
    return {d_means, d_scales, d_quats, d_opacity, d_sh, d_means2d, d_colors, d_camera};
}

// Updates all parameters and, if given, the statistics; returns the gradients of colours and of the
// camera's parameters. moments: the first and the second of means, rotations, log_scales,
// opacity_logits and sh. adams: of means and rotations, log_scales, opacity_logits and sh.
std::tuple<Tensor, Tensor> project_backward_update(
    const Tensor& means, const Tensor& log_scales, const Tensor& quats,
    const Tensor& opacity_logits, const Tensor& sh, const Tensor& view, const Tensor& records,
    const Tensor& radii, const Tensor& slots, const Tensor& slot_gradients,
    std::vector<Tensor> moments, const Tensor& last, std::vector<Tensor> adams,
    OptionalTensor gradient_sum, OptionalTensor seen, bool colors, bool camera, int64_t threads) {
    const splat::View from = view_from(view);
    const splat::ShAdam sh_adam = sh_adam_from(sh, moments[8], moments[9], last, adams[3]);
    const auto moment = [&](int i) { return mutable_floats(moments[i]); };
    const splat::GaussianUpdate update = {mutable_floats(means),
                                          mutable_floats(quats),
                                          mutable_floats(log_scales),
                                          mutable_floats(opacity_logits),
                                          {moment(0), moment(1), moment(2), moment(3)},
                                          {moment(4), moment(5)},
                                          {moment(6), moment(7)},
                                          settings_from(adams[0]),
                                          settings_from(adams[1]),
                                          settings_from(adams[2]),
                                          gradient_sum ? mutable_floats(*gradient_sum) : nullptr,
                                          seen ? mutable_floats(*seen) : nullptr,
                                          floats(radii),
                                          0.5 * double(from.width),
                                          0.5 * double(from.height)};
    Tensor d_colors = new_floats({colors ? means.size(0) : 0, 3});
    Tensor d_camera = new_camera_gradients(camera);
    splat::project_view_backward(gaussians_from(means, log_scales, quats, opacity_logits, sh), from,
                                 int(threads), records_from(records), floats(radii),
                                 slots_from(slots), floats(slot_gradients),
                                 {nullptr, nullptr, nullptr, nullptr, nullptr, nullptr,
                                  colors ? mutable_floats(d_colors) : nullptr},
                                 doubles_or_null(d_camera), &sh_adam, &update);
    return {d_colors, d_camera};
}

// loss, error, ssim, squared error, (H, W, 3) gradient
std::tuple<double, double, double, double, Tensor> l1_ssim(const Tensor& rendered,
                                                           OptionalTensor factor,
                                                           const Tensor& target,
                                                           OptionalTensor mask, double ssim_weight,
                                                           double l2_weight, int64_t threads) {
    const bool bytes = target.scalar_type() == ScalarType::Byte;
    const splat::LossImages images = {rendered.size(1),
                                      rendered.size(0),
                                      floats(rendered),
                                      floats(factor),
                                      factor && factor->dim() == 3,
                                      bytes ? nullptr : floats(target),
                                      bytes ? target.const_data_ptr<uint8_t>() : nullptr,
                                      mask ? mask->const_data_ptr<uint8_t>() : nullptr};
    Tensor grad = new_floats({rendered.size(0), rendered.size(1), 3});
    const splat::LossValues values =
        splat::l1_ssim(images, {ssim_weight, l2_weight}, int(threads), mutable_floats(grad));
    return {values.loss, values.error, values.ssim, values.squared_error, grad};
}

splat::Surroundings surroundings_from(const Tensor& behind, const Tensor& alpha,
                                      const OptionalTensor& front,
                                      const OptionalTensor& transmittance,
                                      const OptionalTensor& correction) {
    const auto bytes = [](const OptionalTensor& t) {
        return t ? t->const_data_ptr<uint8_t>() : nullptr;
    };
    return {alpha.numel(),        bytes(behind),
            bytes(alpha),         bytes(front),
            bytes(transmittance), correction ? correction->const_data_ptr<int8_t>() : nullptr};
}

// (H, W, 3) image
Tensor compose(const Tensor& behind, const Tensor& old_alpha, OptionalTensor front,
               OptionalTensor transmittance, OptionalTensor correction, const Tensor& color,
               const Tensor& alpha, int64_t threads) {
    Tensor image = new_floats({alpha.size(0), alpha.size(1), 3});
    splat::compose(surroundings_from(behind, old_alpha, front, transmittance, correction),
                   floats(color), floats(alpha), int(threads), mutable_floats(image));
    return image;
}

// (H, W, 3) and (H, W) gradients of color and alpha
std::tuple<Tensor, Tensor> compose_backward(const Tensor& behind, const Tensor& old_alpha,
                                            OptionalTensor front, OptionalTensor transmittance,
                                            const Tensor& alpha, const Tensor& d_image,
                                            double weight, double fade, double growth,
                                            int64_t threads) {
    Tensor d_color = new_floats({alpha.size(0), alpha.size(1), 3});
    Tensor d_alpha = new_floats({alpha.size(0), alpha.size(1)});
    splat::compose_backward(surroundings_from(behind, old_alpha, front, transmittance, {}),
                            floats(alpha), floats(d_image),
                            {float(weight), float(fade), float(growth)}, int(threads),
                            mutable_floats(d_color), mutable_floats(d_alpha));
    return {d_color, d_alpha};
}

void observe_gradients(const Tensor& means2d, const Tensor& radii, const Tensor& gradient_sum,
                       const Tensor& seen, double scale_x, double scale_y, int64_t threads) {
    splat::observe_gradients(floats(means2d), floats(radii), scale_x, scale_y, radii.numel(),
                             int(threads), mutable_floats(gradient_sum), mutable_floats(seen));
}

// (H, W, 3) image
void adam_step(const Tensor& param, const Tensor& grad, const Tensor& exp_avg,
               const Tensor& exp_avg_sq, const Tensor& adam, int64_t threads) {
    const splat::AdamSettings settings = settings_from(adam);
    if (exp_avg_sq.numel() == param.numel())
        splat::adam_step(mutable_floats(param), floats(grad), mutable_floats(exp_avg),
                         mutable_floats(exp_avg_sq), param.numel(), settings, int(threads));
    else
        splat::adam_step_rows(mutable_floats(param), floats(grad), mutable_floats(exp_avg),
                              mutable_floats(exp_avg_sq), param.size(0), int(param.size(1)),
                              settings, int(threads));
}

void frame_adam(const Tensor& means, const Tensor& quats, const Tensor& log_scales,
                const Tensor& d_means, const Tensor& d_quats, const Tensor& mean_avg,
                const Tensor& mean_avg_sq, const Tensor& rotation_avg,
                const Tensor& rotation_avg_sq, const Tensor& adam, int64_t threads) {
    splat::frame_adam(mutable_floats(means), mutable_floats(quats), floats(log_scales),
                      floats(d_means), floats(d_quats),
                      {mutable_floats(mean_avg), mutable_floats(mean_avg_sq),
                       mutable_floats(rotation_avg), mutable_floats(rotation_avg_sq)},
                      means.size(0), settings_from(adam), int(threads));
}

// Rows of each tensor, see rows.h.
std::vector<Tensor> take_rows(std::vector<Tensor> tensors, const Tensor& rows,
                              OptionalTensor zeroed, int64_t threads) {
    std::vector<Tensor> taken;
    std::vector<splat::RowCopy> copies;
    for (const Tensor& t : tensors) {
        const auto bytes = int64_t(t.element_size());
        int64_t width = 1;
        std::vector<int64_t> shape = {rows.numel()};
        for (int64_t k = 1; k < t.dim(); k++) width *= t.size(k), shape.push_back(t.size(k));
        taken.push_back(new_tensor(shape, t.scalar_type(), size_t(bytes)));
        copies.push_back({static_cast<const char*>(t.const_data_ptr()),
                          static_cast<char*>(taken.back().mutable_data_ptr()), width * bytes});
    }
    splat::take_rows(copies, rows.const_data_ptr<int64_t>(),
                     zeroed ? zeroed->const_data_ptr<bool>() : nullptr, rows.numel(), int(threads));
    return taken;
}

std::tuple<double, double> loop_time() {
    const splat::LoopTime time = splat::loop_time();
    return {time.loops, time.threads};
}

}  // namespace

STABLE_TORCH_LIBRARY(splatmake, m) {
    m.def(
        "project(Tensor means, Tensor log_scales, Tensor quats, Tensor opacity_logits, Tensor sh, "
        "Tensor view, int threads) -> (Tensor, Tensor, int, int)");
    m.def(
        "bin(Tensor records, Tensor radii, Tensor view, int threads) -> "
        "(Tensor, Tensor, Tensor, bool)");
    m.def(
        "blend(Tensor records, Tensor entries, Tensor tile_begin, Tensor view, int threads) -> "
        "(Tensor, Tensor, Tensor)");
    m.def(
        "blend_depth(Tensor records, Tensor entries, Tensor tile_begin, Tensor view, int threads) "
        "-> (Tensor, Tensor)");
    m.def(
        "blend_backward(Tensor records, Tensor entries, Tensor tile_begin, Tensor block_end, "
        "Tensor view, Tensor color, Tensor alpha, Tensor? depth, Tensor d_color, Tensor? d_alpha, "
        "Tensor? d_depth, int threads) -> Tensor");
    m.def(
        "project_backward(Tensor means, Tensor log_scales, Tensor quats, Tensor opacity_logits, "
        "Tensor(a!) sh, Tensor view, Tensor records, Tensor radii, Tensor slots, "
        "Tensor slot_gradients, bool colors, bool camera, Tensor(b!)? exp_avg, "
        "Tensor(c!)? exp_avg_sq, Tensor(d!)? last, Tensor? adam, int threads) -> "
        "(Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");
    m.def(
        "project_backward_update(Tensor(a!) means, Tensor(b!) log_scales, Tensor(c!) quats, "
        "Tensor(d!) opacity_logits, Tensor(e!) sh, Tensor view, Tensor records, Tensor radii, "
        "Tensor slots, Tensor slot_gradients, Tensor(f!)[] moments, Tensor(g!) last, "
        "Tensor[] adams, Tensor(h!)? gradient_sum, Tensor(i!)? seen, bool colors, bool camera, "
        "int threads) -> (Tensor, Tensor)");
    m.def(
        "l1_ssim(Tensor rendered, Tensor? factor, Tensor target, Tensor? mask, float ssim_weight, "
        "float l2_weight, int threads) -> (float, float, float, float, Tensor)");
    m.def(
        "compose(Tensor behind, Tensor old_alpha, Tensor? front, Tensor? transmittance, "
        "Tensor? correction, Tensor color, Tensor alpha, int threads) -> Tensor");
    m.def(
        "compose_backward(Tensor behind, Tensor old_alpha, Tensor? front, Tensor? transmittance, "
        "Tensor alpha, Tensor d_image, float weight, float fade, float growth, int threads) -> "
        "(Tensor, Tensor)");
    m.def(
        "observe_gradients(Tensor means2d, Tensor radii, Tensor(a!) gradient_sum, Tensor(b!) seen, "
        "float scale_x, float scale_y, int threads) -> ()");
    m.def(
        "adam_step(Tensor(a!) param, Tensor grad, Tensor(b!) exp_avg, Tensor(c!) exp_avg_sq, "
        "Tensor adam, int threads) -> ()");
    m.def(
        "frame_adam(Tensor(a!) means, Tensor(b!) quats, Tensor log_scales, Tensor d_means, "
        "Tensor d_quats, Tensor(c!) mean_avg, Tensor(d!) mean_avg_sq, Tensor(e!) rotation_avg, "
        "Tensor(f!) rotation_avg_sq, Tensor adam, int threads) -> ()");
    m.def("take_rows(Tensor[] tensors, Tensor rows, Tensor? zeroed, int threads) -> Tensor[]");
    m.def("release_memory() -> ()");
    m.def("save_memory(bool little) -> ()");
    m.def("loop_time() -> (float, float)");
}

STABLE_TORCH_LIBRARY_IMPL(splatmake, CPU, m) {
    m.impl("project", TORCH_BOX(&project));
    m.impl("bin", TORCH_BOX(&bin));
    m.impl("blend", TORCH_BOX(&blend));
    m.impl("blend_depth", TORCH_BOX(&blend_depth));
    m.impl("blend_backward", TORCH_BOX(&blend_backward));
    m.impl("project_backward", TORCH_BOX(&project_backward));
    m.impl("project_backward_update", TORCH_BOX(&project_backward_update));
    m.impl("l1_ssim", TORCH_BOX(&l1_ssim));
    m.impl("compose", TORCH_BOX(&compose));
    m.impl("compose_backward", TORCH_BOX(&compose_backward));
    m.impl("observe_gradients", TORCH_BOX(&observe_gradients));
    m.impl("adam_step", TORCH_BOX(&adam_step));
    m.impl("frame_adam", TORCH_BOX(&frame_adam));
    m.impl("take_rows", TORCH_BOX(&take_rows));
}

// They have no tensor that chooses a device.
STABLE_TORCH_LIBRARY_IMPL(splatmake, CompositeExplicitAutograd, m) {
    m.impl("release_memory", TORCH_BOX(&splat::release_unused_memory));
    m.impl("save_memory", TORCH_BOX(&splat::save_memory));
    m.impl("loop_time", TORCH_BOX(&loop_time));
}
