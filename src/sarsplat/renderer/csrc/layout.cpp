// layout.cpp: where the fields of api.h's structures lie, so that Python can compare its mirrors (structs.py).
#include <cstddef>
#include <cstring>

#include "api.h"
#include "export.h"

namespace {

struct Layout { const char* name; int32_t numbers[40]; };  // the size, the offset of every field, -1

#define AT(field) offsetof(S, field)
#define LAYOUT(type, ...) [] { typedef type S; return Layout{#type, {sizeof(S), __VA_ARGS__, -1}}; }()

const Layout kLayouts[] = {
    LAYOUT(sg_problem, AT(peak), AT(views), AT(of_views), AT(gaussians), AT(coefficients), AT(channels), AT(rows), AT(columns), AT(means),
           AT(quaternions), AT(scales), AT(kappa), AT(harmonics), AT(amplitudes), AT(frames), AT(basis), AT(shift), AT(in_sight), AT(p_min), AT(pixel), AT(center),
           AT(response_var), AT(ray), AT(cell_widening), AT(min_ray_depth), AT(min_transmittance), AT(image_cut), AT(min_scale),
           AT(max_scale), AT(max_depth), AT(farthest), AT(strongest), AT(flattest), AT(steepest)),
    LAYOUT(sg_outputs, AT(images), AT(cross_sections), AT(lit_area)),
    LAYOUT(sg_gradients, AT(images), AT(cross_sections), AT(transmittance), AT(means), AT(quaternions), AT(scales), AT(kappa),
           AT(harmonics), AT(amplitudes), AT(shift), AT(planes)),
    LAYOUT(sg_projection, AT(ray_centers), AT(ray_roots), AT(optical_depth), AT(range), AT(tilt), AT(pixel_centers), AT(pixel_roots),
           AT(gamma0)),
    LAYOUT(sg_channels, AT(count), AT(cross_sections), AT(wavenumbers), AT(slopes)),
    LAYOUT(sg_lattice, AT(k0x), AT(k0y), AT(rows), AT(columns)),
    LAYOUT(sg_statistics, AT(blocks_attenuation), AT(live_attenuation), AT(blocks_imaging), AT(live_imaging), AT(lanes)),
    LAYOUT(sg_loss, AT(views), AT(rows), AT(columns), AT(power), AT(truth), AT(window), AT(reference), AT(floor), AT(ssim_weight),
           AT(c1), AT(c2), AT(loss), AT(gradient)),
    LAYOUT(sg_sections, AT(views), AT(pairs), AT(gaussians), AT(shared), AT(means), AT(quaternions), AT(scales), AT(frames), AT(roots),
           AT(numbers), AT(real), AT(imaginary), AT(parts), AT(slopes), AT(d_parts), AT(d_slopes), AT(d_means), AT(d_quaternions),
           AT(d_scales), AT(d_roots), AT(d_real), AT(d_imaginary)),
    LAYOUT(sg_lobes, AT(views), AT(p_min), AT(gaussians), AT(directions), AT(quaternions), AT(scales),
           AT(parameters), AT(amplitudes), AT(d_amplitudes), AT(d_quaternions), AT(d_parameters)),
    LAYOUT(sg_likelihood, AT(views), AT(rows), AT(columns), AT(passes), AT(powers), AT(pairs), AT(reach), AT(power), AT(pair),
           AT(of_channels), AT(of_pairs), AT(phases), AT(noise), AT(truth), AT(loss), AT(d_power), AT(d_pair), AT(d_phases), AT(d_noise),
           AT(failed)),
    LAYOUT(sg_axis, AT(first), AT(step), AT(count)),
    LAYOUT(sg_patches, AT(rows), AT(columns)),
    LAYOUT(sg_ground, AT(views), AT(rows), AT(columns), AT(std), AT(patches), AT(transmittance), AT(shift), AT(lit), AT(d_lit),
           AT(d_transmittance), AT(d_shift)),
    LAYOUT(sg_terrain_patches, AT(rows), AT(across), AT(low), AT(high), AT(traced_first), AT(traced), AT(x), AT(y)),
    LAYOUT(sg_terrain, AT(views), AT(rows), AT(columns), AT(std), AT(cell), AT(places), AT(patches), AT(transmittance), AT(gamma0),
           AT(shift), AT(lit), AT(d_lit), AT(d_transmittance), AT(d_gamma0), AT(d_shift)),
    LAYOUT(sg_adam_group, AT(value), AT(gradient), AT(mean), AT(square), AT(rows), AT(columns), AT(logarithmic), AT(decay), AT(rate),
           AT(low), AT(high)),
    LAYOUT(sg_adam_step, AT(groups), AT(count), AT(beta1), AT(beta2), AT(epsilon), AT(beta1_power), AT(beta2_power)),
};

}  // namespace

// Null for a structure that is not in api.h.
SG_EXPORT const int32_t* sg_layout(const char* name) {
  for (const Layout& layout : kLayouts)
    if (!std::strcmp(layout.name, name)) return layout.numbers;
  return nullptr;
}
