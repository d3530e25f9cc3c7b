// GGX facets of one width or two: their density, what masks them, and how those that are visible are drawn.
//
// Walter et al. 2007; height-correlated masking: Heitz 2014; sampled by bounded visible normals: Dupuy and Benyoub
// 2023, Eto and Tokuyoshi 2023.
#pragma once

#include "lanes.h"
#include "surface.h"

#if GLOSSY

// Below this a lobe is sharper than float can evaluate; roughness 0 is drawn with it.
#define ALPHA_GGX_MIN 1e-3f

// Alphas along x and y.
#if LAYERS
typedef struct {
    Float x;
    Float y;
} Alphas;
static inline Alphas alphas_of(Bsdf b)
{
    Alphas a;
    a.x = b.alpha;
    a.y = b.alpha_y;
    return a;
}
static inline Alphas alphas_equal(Float alpha)
{
    Alphas a;
    a.x = alpha;
    a.y = alpha;
    return a;
}
#define ALPHA_X(a) ((a).x)
#define ALPHA_Y(a) ((a).y)
#define ALPHA_LEAST(a) min((a).x, (a).y)
#else
typedef Float Alphas;
static inline Alphas alphas_of(Bsdf b) { return b.alpha; }
#define ALPHA_X(a) (a)
#define ALPHA_Y(a) (a)
#define ALPHA_LEAST(a) (a)
#endif

/// GGX density of the microfacet normal `h` (local, unit).  From the slopes, because 1 - h.z^2 has
/// cancelled away where the lobe is sharp.
static inline Float ggx_d(Vec3 h, Alphas alpha)
{
#if LAYERS
    const Float x = h.x / alpha.x;
    const Float y = h.y / alpha.y;
    const Float e = x * x + y * y + h.z * h.z;
    return INV_PI / (alpha.x * alpha.y * e * e);
#else
    const Float a2 = alpha * alpha;
    const Float e = (h.x * h.x + h.y * h.y) / a2 + h.z * h.z;
    return INV_PI / (a2 * e * e);
#endif
}

/// Length of (alpha_x x, alpha_y y, z) for a unit vector.
static inline Float ggx_stretch(Vec3 w, Alphas alpha)
{
#if LAYERS
    const Float x = alpha.x * w.x;
    const Float y = alpha.y * w.y;
    return sqrt(x * x + y * y + w.z * w.z);
#else
    return sqrt(alpha * alpha * max(1.0f - w.z * w.z, 0.0f) + w.z * w.z);
#endif
}

/// Height-correlated masking and shadowing over 4 cos_o cos_i; wi.z > 0 is given apart.
static inline Float ggx_visibility(Vec3 wo, Vec3 wi, Float cos_i, Alphas alpha)
{
    const Vec3 i = vec3(wi.x, wi.y, cos_i);
    return 0.5f / max(wo.z * ggx_stretch(i, alpha) + cos_i * ggx_stretch(wo, alpha), 1e-20f);
}

/// Part of the light from wo to a facet that others let pass on to w; cos_w = |w.z| > 0, `stretch` that of wo.
static inline Float ggx_seen_too(Vec3 wo, Float stretch, Vec3 w, Float cos_w, Alphas alpha)
{
    return cos_w * (wo.z + stretch) / max(cos_w * stretch + wo.z * ggx_stretch(w, alpha), 1e-20f);
}

/// Share of the cap of visible normals that can reflect above the horizon (the k of Eto, Tokuyoshi).
static inline Float ggx_bound(Vec3 wo, Alphas alpha)
{
    const Float s = 1.0f + sqrt(max(1.0f - wo.z * wo.z, 0.0f));
    const Float least = ALPHA_LEAST(alpha);
    const Float a2 = least * least;
    const Float s2 = s * s;
    return (1.0f - a2) * s2 / (s2 + a2 * wo.z * wo.z);
}

/// Draw a microfacet normal visible from wo; `bound` is ggx_bound for a reflection, 1 for all of them.
static inline Vec3 sample_ggx(Vec3 wo, Alphas alpha, Float bound, Float u1, Float u2)
{
    const Vec3 stretched = normalize3(vec3(ALPHA_X(alpha) * wo.x, ALPHA_Y(alpha) * wo.y, wo.z));
    const Float lowest = bound * stretched.z;
    const Float z = (1.0f - u1) * (1.0f + lowest) - lowest;
    const Float radius = sqrt(clamp(1.0f - z * z, (Float)(0.0f), (Float)(1.0f)));
    Float c;
    Float s;
    cos_sin_turns(u2, &c, &s);
    const Vec3 h = vec3(radius * c + stretched.x, radius * s + stretched.y, z + stretched.z);
    return normalize3(vec3(ALPHA_X(alpha) * h.x, ALPHA_Y(alpha) * h.y, max(h.z, (Float)(1e-6f))));
}

/// Density of the direction that sample_ggx with ggx_bound reflects into.
static inline Float pdf_ggx_reflect(Vec3 wo, Vec3 h, Alphas alpha)
{
    return ggx_d(h, alpha) / (2.0f * (ggx_bound(wo, alpha) * wo.z + ggx_stretch(wo, alpha)));
}

#endif
