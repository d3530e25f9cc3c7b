// Atomic adds to two words side by side, at once where the device can: one takes as long for two as for one.
#pragma once

#if defined(cl_khr_int64_base_atomics) && defined(__ENDIAN_LITTLE__) && !defined(PLAIN_C)
#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable

/// Add to two words, `words` being a multiple of 8 bytes.  Returns the carry of the first; `second_carry` receives
/// that of the other, which may be -1.
static inline uint add_words(volatile __global uint *words, uint first, uint second, uint *second_carry)
{
    volatile __global ulong *both = (volatile __global ulong *)words;
    const ulong before = atom_add(both, (ulong)second << 32 | first);
    const uint carry = (uint)before + first < first;
    *second_carry = (uint)(((before >> 32) + second + carry) >> 32);
    // The first word's carry went into the second, where it does not belong.
    if (carry != 0u && atom_sub(both, 0x100000000ul) >> 32 == 0u)
        --*second_carry;
    return carry;
}
#else
static inline uint add_words(volatile __global uint *words, uint first, uint second, uint *second_carry)
{
    *second_carry = second != 0u && atomic_add(&words[1], second) + second < second;
    return first != 0u && atomic_add(&words[0], first) + first < first;
}
#endif
