// W paths at once: one text for W = 1 (a GPU, and the plain meaning of the code), 8 and 16 (a CPU).
//
// Float, UInt and Mask hold one value a lane; operators work lane by lane.  A branch on data is
// pick(mask, then, otherwise).  A Mask is 0 or -1 (0 or 1 for W = 1): combine it with & | and !, never
// with ~.  Dead lanes may hold anything: mask them by pick, never by multiplying with 0.
#pragma once

#include "layout.h"

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)

#if W == 1
typedef float Float;
typedef int Int;
typedef uint UInt;
typedef int Mask;
#elif W == 8 || W == 16
typedef JOIN(float, W) Float;
typedef JOIN(int, W) Int;
typedef JOIN(uint, W) UInt;
typedef JOIN(int, W) Mask;
#else
#error "W must be 1, 8 or 16"
#endif

// any() of PoCL looks at one lane after the other: twice the time in a loop over triangles.  Only where
// lanes make a CPU likely: other compilers may not know what to do with the builtin.
#define ANY(mask) any(mask)
#ifdef __has_builtin
#if W > 1 && !defined(PLAIN_C) && __has_builtin(__builtin_reduce_or)
#define REDUCE_OR(mask) __builtin_reduce_or(mask)
#undef ANY
#define ANY(mask) (REDUCE_OR(mask) != 0)
#endif
#endif

// A large function: on a CPU it stays apart, for compilers take longer over one large kernel than over
// its parts (measured on shade_paths: half the time, no difference in speed).
#if W == 1
#define LARGE_FUNCTION static inline
#else
#define LARGE_FUNCTION static __attribute__((noinline))
#endif

// pick(mask, then, otherwise) for Float, pick_u for UInt, pick_m for Mask;
// count_lanes(mask): how many; any_lane(mask): whether one; lanes_before(mask): how many lower ones a lane has;
// lane_bits(mask): bit k is set where lane k is; lanes_of(bits): back; least_lane(x): the least.
// GATHER(array, index, member): array[index].member of every lane, GATHER_U the same for uint;
// GATHER_WORD(array, index): array[index] of uints; gather_words(array, index): of floats.
#if W == 1
static inline float pick(int mask, float then, float otherwise) { return mask ? then : otherwise; }
static inline uint pick_u(int mask, uint then, uint otherwise) { return mask ? then : otherwise; }
static inline int any_lane(int mask) { return mask != 0; }
static inline uint count_lanes(int mask) { return mask != 0; }
static inline uint lanes_before(int mask) { return 0; }
static inline uint lane_bits(int mask) { return mask != 0; }
static inline int lanes_of(uint bits) { return bits & 1u; }
static inline float least_lane(float x) { return x; }
static inline float to_float(uint x) { return (float)x; }
static inline uint to_uint(float x) { return (uint)x; }
static inline uint as_bits(float x) { return as_uint(x); }
static inline float from_bits(uint x) { return as_float(x); }
static inline void store_lanes(float x, float *array) { array[0] = x; }
static inline void store_lanes_u(uint x, uint *array) { array[0] = x; }
static inline float load_lanes(const float *array) { return array[0]; }
static inline uint load_lanes_u(const uint *array) { return array[0]; }
#define GATHER(array, index, member) ((array)[index].member)
#define GATHER_U(array, index, member) ((array)[index].member)
#define GATHER_WORD(array, index) ((array)[index])
static inline float gather_words(__global const float *words, uint at) { return words[at]; }
#else
static inline Float pick(Mask mask, Float then, Float otherwise) { return select(otherwise, then, mask); }
static inline UInt pick_u(Mask mask, UInt then, UInt otherwise) { return select(otherwise, then, mask); }
static inline int any_lane(Mask mask) { return ANY(mask); }
static inline Float to_float(UInt x) { return JOIN(convert_float, W)(x); }
static inline UInt to_uint(Float x) { return JOIN(convert_uint, W)(x); }
static inline UInt as_bits(Float x) { return JOIN(as_uint, W)(x); }
static inline UInt as_lanes_u(Mask x) { return JOIN(as_uint, W)(x); }
static inline Float from_bits(UInt x) { return JOIN(as_float, W)(x); }
static inline void store_lanes(Float x, float *array) { JOIN(vstore, W)(x, 0, array); }
static inline void store_lanes_u(UInt x, uint *array) { JOIN(vstore, W)(x, 0, array); }
static inline Float load_lanes(const float *array) { return JOIN(vload, W)(0, array); }
static inline UInt load_lanes_u(const uint *array) { return JOIN(vload, W)(0, array); }
#if W == 8
static inline uint count_lanes(Mask mask)
{
    const int4 a = mask.lo + mask.hi;
    const int2 b = a.lo + a.hi;
    return (uint)(-(b.x + b.y));
}
#define GATHER_(type, words, at)                                                                     \
    ((type)((words)[(at).s0], (words)[(at).s1], (words)[(at).s2], (words)[(at).s3],                \
            (words)[(at).s4], (words)[(at).s5], (words)[(at).s6], (words)[(at).s7]))
#else
static inline uint count_lanes(Mask mask)
{
    const int8 a = mask.lo + mask.hi;
    const int4 b = a.lo + a.hi;
    const int2 c = b.lo + b.hi;
    return (uint)(-(c.x + c.y));
}
#define GATHER_(type, words, at)                                                                     \
    ((type)((words)[(at).s0], (words)[(at).s1], (words)[(at).s2], (words)[(at).s3],                \
            (words)[(at).s4], (words)[(at).s5], (words)[(at).s6], (words)[(at).s7],                \
            (words)[(at).s8], (words)[(at).s9], (words)[(at).sa], (words)[(at).sb],                \
            (words)[(at).sc], (words)[(at).sd], (words)[(at).se], (words)[(at).sf]))
#endif
#if W == 8
#define SHIFT_1(x) ((UInt)(0, (x).s0, (x).s1, (x).s2, (x).s3, (x).s4, (x).s5, (x).s6))
#define SHIFT_2(x) ((UInt)(0, 0, (x).s0, (x).s1, (x).s2, (x).s3, (x).s4, (x).s5))
#define SHIFT_4(x) ((UInt)(0, 0, 0, 0, (x).s0, (x).s1, (x).s2, (x).s3))
#define LANE_BITS ((Int)(1, 2, 4, 8, 16, 32, 64, 128))
#else
#define SHIFT_1(x) ((UInt)(0, (x).s0, (x).s1, (x).s2, (x).s3, (x).s4, (x).s5, (x).s6, (x).s7, (x).s89ab, (x).scd, (x).se))
#define SHIFT_2(x) ((UInt)(0, 0, (x).s01234567, (x).s89ab, (x).scd))
#define SHIFT_4(x) ((UInt)(0, 0, 0, 0, (x).s01234567, (x).s89ab))
#define SHIFT_8(x) ((UInt)((uint8)(0), (x).s01234567))
#define LANE_BITS                                                                                  \
    ((Int)(1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768))
#endif
static inline UInt lanes_before(Mask mask)
{
    UInt sum = as_lanes_u(mask) & 1u;
    sum = SHIFT_1(sum);
    sum += SHIFT_1(sum);
    sum += SHIFT_2(sum);
    sum += SHIFT_4(sum);
#if W == 16
    sum += SHIFT_8(sum);
#endif
    return sum;
}
static inline uint lane_bits(Mask mask)
{
#if W == 16 && defined(__AVX512DQ__)
    return (ushort)__builtin_ia32_cvtd2mask512(mask);
#elif defined(REDUCE_OR)
    return (uint)REDUCE_OR(mask & LANE_BITS);
#else
    int lane[W];
    JOIN(vstore, W)(mask, 0, lane);
    uint bits = 0;
    for (uint k = 0; k < W; ++k)
        bits |= lane[k] ? 1u << k : 0u;
    return bits;
#endif
}
static inline Mask lanes_of(uint bits) { return ((Int)((int)bits) & LANE_BITS) != 0; }
static inline float least_lane(Float x)
{
#if W == 16
    const JOIN(float, 8) a = min(x.lo, x.hi);
#else
    const Float a = x;
#endif
    const float4 b = min(a.lo, a.hi);
    const float2 c = min(b.lo, b.hi);
    return min(c.x, c.y);
}
#define WORDS_OF(array) ((uint)(sizeof(*(array)) / 4))
#if W == 16 && defined(__AVX512F__)
// The processor's own gather: compilers do not find it, and shade_paths takes 1.3 times as long without.
static inline Float gather_words(__global const float *words, UInt at)
{
    return __builtin_ia32_gathersiv16sf((Float)(0.0f), (const void *)(ulong)words, as_int16(at), (ushort)0xffff, 4);
}
#else
static inline Float gather_words(__global const float *words, UInt at) { return GATHER_(Float, words, at); }
#endif
#define GATHER(array, index, member)                                                               \
    gather_words((__global const float *)&(array)->member, (index)*WORDS_OF(array))
#define GATHER_U(array, index, member) as_bits(GATHER(array, index, member))
#define GATHER_WORD(array, index) as_bits(gather_words((__global const float *)(array), index))
#endif

#ifdef CHECK_INDICES
// Only in checked sources (`index_checks.py`).
#if W == 1
#undef GATHER
#undef GATHER_U
#undef GATHER_WORD
#define GATHER(array, index, member) ((array)[AT(array, index)].member)
#define GATHER_U(array, index, member) GATHER(array, index, member)
#define GATHER_WORD(array, index) ((array)[AT(array, index)])
#define gather_words(words, at) ((words)[AT(words, at)])
#else
static inline UInt indices_checked(__global const void *array, UInt index, uint size, uint site)
{
    uint lane[W];
    store_lanes_u(index, lane);
    for (uint k = 0; k < W; ++k)
        lane[k] = (uint)index_checked(array, lane[k], 1u, size, site);
    return load_lanes_u(lane);
}
static inline Float gather_unchecked(__global const float *words, UInt at) { return gather_words(words, at); }
#define LANES_AT(array, index) \
    indices_checked((__global const void *)(array), index, (uint)sizeof(*(array)), SITE)
#undef GATHER
#define GATHER(array, index, member)                                                               \
    gather_unchecked((__global const float *)&(array)->member, LANES_AT(array, index) * WORDS_OF(array))
#define gather_words(words, at) gather_unchecked(words, LANES_AT(words, at))
#endif
#endif

/// 1 / sqrt(x) within 1e-4, where only chances follow from it.
#if W == 16 && defined(__AVX512F__)
static inline Float rough_rsqrt(Float x)
{
    return __builtin_ia32_rsqrt14ps512_mask(x, (Float)(0.0f), (ushort)0xffff);
}
#else
static inline Float rough_rsqrt(Float x) { return rsqrt(x); }
#endif

/// Index of the lowest set bit; `bits` is not 0.
static inline uint lowest_bit(uint bits) { return popcount((bits - 1u) & ~bits); }

#define MASK_ALL ((Mask)(-1))

#define PI 3.14159265358979f
#define INV_PI 0.318309886183791f

/// Three values a lane: a vector, a point or a colour.
typedef struct {
    Float x;
    Float y;
    Float z;
} Vec3;

static inline Vec3 vec3(Float x, Float y, Float z)
{
    Vec3 v;
    v.x = x;
    v.y = y;
    v.z = z;
    return v;
}
static inline Vec3 vec3_of(const __global float *p) { return vec3((Float)(p[0]), (Float)(p[1]), (Float)(p[2])); }
static inline Vec3 vec3_all(Float x) { return vec3(x, x, x); }
static inline Vec3 add(Vec3 a, Vec3 b) { return vec3(a.x + b.x, a.y + b.y, a.z + b.z); }
static inline Vec3 sub(Vec3 a, Vec3 b) { return vec3(a.x - b.x, a.y - b.y, a.z - b.z); }
static inline Vec3 mul(Vec3 a, Vec3 b) { return vec3(a.x * b.x, a.y * b.y, a.z * b.z); }
static inline Vec3 scale(Vec3 a, Float s) { return vec3(a.x * s, a.y * s, a.z * s); }
static inline Vec3 add_scaled(Vec3 a, Vec3 b, Float s) { return vec3(a.x + b.x * s, a.y + b.y * s, a.z + b.z * s); }
static inline Float dot3(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline Vec3 cross3(Vec3 a, Vec3 b)
{
    return vec3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}
static inline Vec3 pick_v(Mask mask, Vec3 then, Vec3 otherwise)
{
    return vec3(pick(mask, then.x, otherwise.x), pick(mask, then.y, otherwise.y),
                pick(mask, then.z, otherwise.z));
}
static inline Vec3 lerp3(Vec3 a, Vec3 b, Float t) { return add_scaled(a, sub(b, a), t); }
static inline Float luminance(Vec3 rgb)
{
    return LUMINANCE_RED * rgb.x + LUMINANCE_GREEN * rgb.y + LUMINANCE_BLUE * rgb.z;
}
static inline Float max3(Vec3 a) { return max(a.x, max(a.y, a.z)); }

/// normalize3 where the square of the length leaves the range of float.
LARGE_FUNCTION Vec3 normalize3_scaled(Vec3 v)
{
    const Float largest = max(fabs(v.x), max(fabs(v.y), fabs(v.z)));
    const Mask ok = (largest >= FLT_MIN) & (largest < INFINITY);
    const Vec3 s = scale(v, 1.0f / pick(ok, largest, (Float)(1.0f)));
    const Vec3 unit = scale(s, 1.0f / sqrt(dot3(s, s)));
    return pick_v(ok, unit, vec3((Float)(0.0f), (Float)(0.0f), (Float)(1.0f)));
}

/// Unit vector along `v`; (0, 0, 1) where `v` has no direction, or is too small for its reciprocal.
static inline Vec3 normalize3(Vec3 v)
{
    const Float length2 = dot3(v, v);
    const Mask ok = (length2 > 0x1p-100f) & (length2 < 0x1p100f);
    const Vec3 unit = scale(v, 1.0f / sqrt(length2));
    if (!any_lane(!ok))
        return unit;
    return pick_v(ok, unit, normalize3_scaled(v));
}

/// Unit vector along `v` whose length is 1 but for rounding: a step of Newton's method.
static inline Vec3 renormalize3(Vec3 v) { return scale(v, 1.5f - 0.5f * dot3(v, v)); }

/// Two unit vectors that make a right-handed frame with the unit vector `n`.
///
/// Duff et al.: Building an Orthonormal Basis, Revisited, JCGT 6 (1), 2017.
static inline void make_frame(Vec3 n, Vec3 *s, Vec3 *t)
{
    const Float sign = pick(n.z >= 0.0f, (Float)(1.0f), (Float)(-1.0f));
    const Float a = -1.0f / (sign + n.z);
    const Float b = n.x * n.y * a;
    *s = vec3(1.0f + sign * n.x * n.x * a, sign * b, -sign * n.x);
    *t = vec3(b, sign + n.y * n.y * a, -n.y);
}

/// Cosine and sine of 2 pi `turns`, for `turns` in [0, 1]; Taylor series on an eighth of a turn
/// (error below 1e-7).  Library calls are scalar on PoCL: 30 ns each.
static inline void cos_sin_turns(Float turns, Float *cosine, Float *sine)
{
    const Float quarter = floor(turns * 4.0f + 0.5f);
    const Float x = (turns * 4.0f - quarter) * 1.57079632679490f;
    const Float y = x * x;
    const Float s =
        x * (1.0f + y * (-1.6666667e-1f + y * (8.3333333e-3f + y * (-1.9841270e-4f + y * 2.7557319e-6f))));
    const Float c =
        1.0f
        + y * (-0.5f + y * (4.1666667e-2f + y * (-1.3888889e-3f + y * (2.4801587e-5f + y * -2.7557319e-7f))));
    const UInt q = to_uint(quarter);
    const Mask swap = (q & 1u) != 0u;
    const Mask cosine_minus = ((q + 1u) & 2u) != 0u;
    const Mask sine_minus = (q & 2u) != 0u;
    const Float ca = pick(swap, s, c);
    const Float sa = pick(swap, c, s);
    *cosine = pick(cosine_minus, -ca, ca);
    *sine = pick(sine_minus, -sa, sa);
}

/// Angle of (x, y) from the positive x axis in (-pi, pi]; 0 for (0, 0).
///
/// Two half-angle steps bring the ratio below 0.2, where the series to x^9 is exact to float.
static inline Float atan2_lanes(Float y, Float x)
{
    const Float ax = fabs(x);
    const Float ay = fabs(y);
    const Float longer = max(ax, ay);
    const Float ratio = min(ax, ay) / pick(longer > 0.0f, longer, (Float)(1.0f));
    const Float half_ratio = ratio / (1.0f + sqrt(1.0f + ratio * ratio));
    const Float r = half_ratio / (1.0f + sqrt(1.0f + half_ratio * half_ratio));
    const Float z = r * r;
    Float angle =
        4.0f * r * (1.0f + z * (-3.3333333e-1f + z * (0.2f + z * (-1.4285714e-1f + z * 1.1111111e-1f))));
    angle = pick(ay > ax, 1.57079632679490f - angle, angle);
    angle = pick(x < 0.0f, PI - angle, angle);
    return pick(y < 0.0f, -angle, angle);
}
