// Written by tools/make_layout.py from psf_cl/device/layout.py: change that, then run it.
#pragma once

#define LEAF_BIT 0x80000000u // child[] is a block of triangles
#define GROUP_BIT 0x40000000u // child[] of a LightPair is a group of lights for photons
#define CLUSTER_BIT 0x20000000u // child[] of a LightPair is a cluster of lights
#define NODE_MASK 0x1FFFFFFFu // what child[] of a LightPair says beside these and LEAF_BIT
#define CLUSTER_LIGHT 0u // of light_clusters, by slot: the light that it keeps
#define CLUSTER_KEEP 1u // by slot: chance that it keeps it, float
#define CLUSTER_OTHER 2u // by slot: the light otherwise
#define CLUSTER_CHANCE 3u // by light: that its cluster draws it, float
#define CLUSTER_PLACE 4u // by light: 2 * pair + side of its cluster; NO_LIGHT for none
#define CLUSTER_FIRST 5u // by pair that is a cluster: its first slot
#define CLUSTER_LENGTH 6u // by pair: how many slots it has; 0 for none
#define CLUSTER_PARTS 7u // each as long as there are lights
#define ALPHA_BIT 0x80000000u // id[] needs its alpha looked up
#define PLATE_TURN 28u // bit of the number of a corner
#define NO_HIT 0xFFFFFFFFu
#define NO_LIGHT 0xFFFFFFFFu
#define NO_VERTEX 0xFFFFFFFFu // it does not move
#define NO_TEXTURE 0xFFFFFFFFu
#define OWN_MATERIAL 0xFFFFFFFFu // each triangle has its own
#define MATERIAL_TWO_SIDED_EMISSION 1u
#define MATERIAL_ALPHA_MASK 2u // hits must look up the alpha
#define MATERIAL_ALPHA_BLEND 4u // with a chance of alpha a hit is there
#define MATERIAL_UNLIT 8u // what it emits is its base colour; it is no light
#define MATERIAL_THIN 16u // a sheet of glass: light goes through unbent
#define MATERIAL_HIDES_BACK 32u // the camera looks through what it would see from behind
#define TEXTURE_CLAMP_U 1u
#define TEXTURE_MIRROR_U 2u
#define TEXTURE_CLAMP_V 4u
#define TEXTURE_MIRROR_V 8u
#define TEXTURE_NEAREST 16u
#define TEXTURE_SRGB 32u
#define LIGHT_RECTANGLE 256u // the light is two triangles: e1 and e2 are edges of a rectangle
#define LIGHT_SPHERE 512u // the light is a sphere: many triangles
#define LIGHT_DISK 1024u // of the rectangle only the disk in it gives light
#define LIGHT_TRIANGLE 0u
#define LIGHT_ENVIRONMENT 1u
#define LIGHT_POINT 2u
#define LIGHT_SPOT 3u
#define LIGHT_DIRECTIONAL 4u
#define DIRECT_MIS 0u
#define DIRECT_LIGHT 1u
#define DIRECT_BSDF 2u
#define SAMPLER_SOBOL 0u
#define SAMPLER_RANDOM 1u
#define PAIR_VERTEX 2u // first pair of random numbers of the first vertex
#define VERTEX_PAIRS 4u // pairs of each vertex
#define DISK_SEGMENTS 64u // corners of a light that is a disk
#define SPHERE_COLUMNS 64u // of faces of a light that is a sphere
#define SPHERE_ROWS 32u
#define STRIP_ROWS 4u // rows of pixels that the queue takes column by column
#define RESTORE_TILE 16u // edge of the tiles whose noise filter_restore compares, pixels
#define STATUS_IDLE 0u // the slot has no path yet
#define STATUS_WAITING 0x40000000u // it holds a sample whose pass may not start yet
#define STATUS_ALIVE 0x80000000u // it traces a ray
#define STATUS_DONE 0xC0000000u // the path ended, the film does not have it yet
#define STATUS_MASK 0xC0000000u
#define DEPTH_MASK 0x3FFFFFFFu // bounces so far
#define FILTER_AUTO 0u // the first vertex that a wide lobe reached, over more than a cell
#define FILTER_NONE 0xFFFFFFFFu // no vertex
#define VERTEX_NEAR 0x80000000u // set if the path met a surface within a cell of its vertex
#define VERTEX_FACE_SHIFT 27u // first bit of the side that a surface near the vertex faces
#define VERTEX_FACE_MASK 7u // of that, shifted: axis and sign, 0 to 5
#define VERTEX_REJECTED 0x40000000u // set if what was gathered is too large for a cell
#define VERTEX_WALL_SHIFT 24u // first bit of what separates the vertex from where it is stored
#define VERTEX_WALL_MASK 7u // of that, shifted: 0 nothing, or 1 + the side that a wall faces
#define VERTEX_GLOSSY 0x00200000u // set if coats and metals share what they reflect there
#define VERTEX_SKY 0x00400000u // set if its shadow ray goes where the sky is even: that light is shared
#define VERTEX_MASK 0x001FFFFFu // 1 + depth
#define CELL_JITTER 1u // points are moved before they are told apart by cells
#define CELL_NEAR 4u // samples of light from near have cells of their own
#define CELL_IDENTITY 2u // every sample has a cell of its own: nothing is shared (tests)
#define SHAPE_MOVES 0x80000000u // its triangles move between frames
#define SHAPE_SHINES 0x40000000u // it glows where it is seen
#define RULE_OFF 0u // frames know nothing of one another
#define RULE_EXPONENTIAL 1u // a frame has a constant weight
#define RULE_CUMULATIVE 2u // all samples since it was first seen have the same weight
#define RULE_ADAPTIVE 3u // the same where nothing changes, more for new ones where something does
#define PROBE_TILE 4u // edge of the tiles that have a probe each, pixels
#define HISTORY_THERE 1u // there is a frame before
#define HISTORY_STILL 2u // neither camera nor geometry has moved since
#define HISTORY_SAME_VIEW 4u // the camera has not moved since
#define HISTORY_CHANGED 8u // probes have looked for changes of light since
#define GUIDE_SIDE 8u // parts of the hemisphere a side of the square
#define GUIDE_BINS 64u
#define RAY_WORDS 19u // of a path, for each shadow ray after the first
#define VIRTUAL_LIGHTS_MOST 8192u // slots of the table of virtual lights
#define VIRTUAL_SHIFT 19u // of random numbers, down to its slots
#define PARTICLE_PLACES 64u // of a cell of the map of photons
#define PARTICLE_KINDS 14u // groups of lights that a cell of it knows at most
#define PARTICLE_SIZES 3u // of cells of that map, each four times as wide as the one before
#define BUCKET_SLOTS 64u // slots of a hash map that are probed for a key
#define OFFSET_EPSILON 9.5367431640625e-07f // rounding error of a point, relative to its coordinates
#define LUMINANCE_RED 0.2126f
#define LUMINANCE_GREEN 0.7152f
#define LUMINANCE_BLUE 0.0722f
#define TEXEL_STEPS 16777216.0f // fixed-point steps of sums of texels, which are from 0 to 1
#define SAME_SURFACE_COSINE 0.9f // normals further apart are those of different surfaces
#define NOISE_UNKNOWN 1e+30f // variance of light of which too little is known to tell it

#define PATH_ORIGIN_X 0u // ray origin, world, m
#define PATH_ORIGIN_Y 1u
#define PATH_ORIGIN_Z 2u
#define PATH_DIRECTION_X 3u // unit ray direction
#define PATH_DIRECTION_Y 4u
#define PATH_DIRECTION_Z 5u
#define PATH_HIT_TRIANGLE 6u // uint; NO_HIT if the ray left the scene
#define PATH_HIT_T 7u // m
#define PATH_HIT_U 8u // barycentric coordinate of the second corner
#define PATH_HIT_V 9u // barycentric coordinate of the third corner
#define PATH_BETA_R 10u // throughput
#define PATH_BETA_G 11u
#define PATH_BETA_B 12u
#define PATH_RADIANCE_R 13u // gathered so far
#define PATH_RADIANCE_G 14u
#define PATH_RADIANCE_B 15u
#define PATH_DIRECT_R 16u // of that, what light reflected at most once brought
#define PATH_DIRECT_G 17u
#define PATH_DIRECT_B 18u
#define PATH_PDF 19u // solid-angle density of the direction; PDF_DELTA if lights are not sampled for it
#define PATH_STATUS 20u // uint; STATUS_* bits and the depth
#define PATH_SAMPLE 21u // uint; index of the sample, which is its pass
#define PATH_PIXEL 22u // uint; position in the order of pixels
#define PATH_SEED 23u // uint; of the pixel, by its place on the film
#define PATH_SHADOW_X 24u // shadow ray origin, world, m
#define PATH_SHADOW_Y 25u
#define PATH_SHADOW_Z 26u
#define PATH_TOWARD_X 27u // from there to the light, not normalised: the light is at t = 1
#define PATH_TOWARD_Y 28u
#define PATH_TOWARD_Z 29u
#define PATH_LIGHT_R 30u // radiance that arrives if nothing is in between, times beta; all 0: no ray
#define PATH_LIGHT_G 31u
#define PATH_LIGHT_B 32u
#if TRANSMISSION >= 1
#define PATH_DENSER (33u + 0u) // by what glass around it makes beta smaller: its indices squared, multiplied
#define PATH_END_1 (33u + 1u)
#else
#define PATH_END_1 33u
#endif
#if LIGHT_SAMPLING >= 1
#define PATH_LIGHT_NORMAL (PATH_END_1 + 0u) // uint; packed: what the last light was chosen for, besides the origin
#define PATH_END_2 (PATH_END_1 + 1u)
#else
#define PATH_END_2 PATH_END_1
#endif
#if LIGHT_SAMPLING >= 2
#define PATH_PARTICLE_ROW (PATH_END_2 + 0u) // uint; row of the table of photons that it was chosen by
#define PATH_END_3 (PATH_END_2 + 1u)
#else
#define PATH_END_3 PATH_END_2
#endif
#if SHADOW_RAYS >= 2
#define PATH_RAY2_SHADOW_X (PATH_END_3 + 0u) // of shadow ray 2
#define PATH_RAY2_SHADOW_Y (PATH_END_3 + 1u) // of shadow ray 2
#define PATH_RAY2_SHADOW_Z (PATH_END_3 + 2u) // of shadow ray 2
#define PATH_RAY2_TOWARD_X (PATH_END_3 + 3u) // of shadow ray 2
#define PATH_RAY2_TOWARD_Y (PATH_END_3 + 4u) // of shadow ray 2
#define PATH_RAY2_TOWARD_Z (PATH_END_3 + 5u) // of shadow ray 2
#define PATH_RAY2_LIGHT_R (PATH_END_3 + 6u) // of shadow ray 2
#define PATH_RAY2_LIGHT_G (PATH_END_3 + 7u) // of shadow ray 2
#define PATH_RAY2_LIGHT_B (PATH_END_3 + 8u) // of shadow ray 2
#define PATH_RAY2_LIGHT_SHARE_R (PATH_END_3 + 9u) // of shadow ray 2
#define PATH_RAY2_LIGHT_SHARE_G (PATH_END_3 + 10u) // of shadow ray 2
#define PATH_RAY2_LIGHT_SHARE_B (PATH_END_3 + 11u) // of shadow ray 2
#define PATH_RAY2_BASE_LIGHT_R (PATH_END_3 + 12u) // of shadow ray 2
#define PATH_RAY2_BASE_LIGHT_G (PATH_END_3 + 13u) // of shadow ray 2
#define PATH_RAY2_BASE_LIGHT_B (PATH_END_3 + 14u) // of shadow ray 2
#define PATH_RAY2_CACHE_LIGHT_R (PATH_END_3 + 15u) // of shadow ray 2
#define PATH_RAY2_CACHE_LIGHT_G (PATH_END_3 + 16u) // of shadow ray 2
#define PATH_RAY2_CACHE_LIGHT_B (PATH_END_3 + 17u) // of shadow ray 2
#define PATH_RAY2_GUIDE_LIGHT (PATH_END_3 + 18u) // of shadow ray 2
#define PATH_END_4 (PATH_END_3 + 19u)
#else
#define PATH_END_4 PATH_END_3
#endif
#if SHADOW_RAYS >= 3
#define PATH_RAY3_SHADOW_X (PATH_END_4 + 0u) // of shadow ray 3
#define PATH_RAY3_SHADOW_Y (PATH_END_4 + 1u) // of shadow ray 3
#define PATH_RAY3_SHADOW_Z (PATH_END_4 + 2u) // of shadow ray 3
#define PATH_RAY3_TOWARD_X (PATH_END_4 + 3u) // of shadow ray 3
#define PATH_RAY3_TOWARD_Y (PATH_END_4 + 4u) // of shadow ray 3
#define PATH_RAY3_TOWARD_Z (PATH_END_4 + 5u) // of shadow ray 3
#define PATH_RAY3_LIGHT_R (PATH_END_4 + 6u) // of shadow ray 3
#define PATH_RAY3_LIGHT_G (PATH_END_4 + 7u) // of shadow ray 3
#define PATH_RAY3_LIGHT_B (PATH_END_4 + 8u) // of shadow ray 3
#define PATH_RAY3_LIGHT_SHARE_R (PATH_END_4 + 9u) // of shadow ray 3
#define PATH_RAY3_LIGHT_SHARE_G (PATH_END_4 + 10u) // of shadow ray 3
#define PATH_RAY3_LIGHT_SHARE_B (PATH_END_4 + 11u) // of shadow ray 3
#define PATH_RAY3_BASE_LIGHT_R (PATH_END_4 + 12u) // of shadow ray 3
#define PATH_RAY3_BASE_LIGHT_G (PATH_END_4 + 13u) // of shadow ray 3
#define PATH_RAY3_BASE_LIGHT_B (PATH_END_4 + 14u) // of shadow ray 3
#define PATH_RAY3_CACHE_LIGHT_R (PATH_END_4 + 15u) // of shadow ray 3
#define PATH_RAY3_CACHE_LIGHT_G (PATH_END_4 + 16u) // of shadow ray 3
#define PATH_RAY3_CACHE_LIGHT_B (PATH_END_4 + 17u) // of shadow ray 3
#define PATH_RAY3_GUIDE_LIGHT (PATH_END_4 + 18u) // of shadow ray 3
#define PATH_END_5 (PATH_END_4 + 19u)
#else
#define PATH_END_5 PATH_END_4
#endif
#if SHADOW_RAYS >= 4
#define PATH_RAY4_SHADOW_X (PATH_END_5 + 0u) // of shadow ray 4
#define PATH_RAY4_SHADOW_Y (PATH_END_5 + 1u) // of shadow ray 4
#define PATH_RAY4_SHADOW_Z (PATH_END_5 + 2u) // of shadow ray 4
#define PATH_RAY4_TOWARD_X (PATH_END_5 + 3u) // of shadow ray 4
#define PATH_RAY4_TOWARD_Y (PATH_END_5 + 4u) // of shadow ray 4
#define PATH_RAY4_TOWARD_Z (PATH_END_5 + 5u) // of shadow ray 4
#define PATH_RAY4_LIGHT_R (PATH_END_5 + 6u) // of shadow ray 4
#define PATH_RAY4_LIGHT_G (PATH_END_5 + 7u) // of shadow ray 4
#define PATH_RAY4_LIGHT_B (PATH_END_5 + 8u) // of shadow ray 4
#define PATH_RAY4_LIGHT_SHARE_R (PATH_END_5 + 9u) // of shadow ray 4
#define PATH_RAY4_LIGHT_SHARE_G (PATH_END_5 + 10u) // of shadow ray 4
#define PATH_RAY4_LIGHT_SHARE_B (PATH_END_5 + 11u) // of shadow ray 4
#define PATH_RAY4_BASE_LIGHT_R (PATH_END_5 + 12u) // of shadow ray 4
#define PATH_RAY4_BASE_LIGHT_G (PATH_END_5 + 13u) // of shadow ray 4
#define PATH_RAY4_BASE_LIGHT_B (PATH_END_5 + 14u) // of shadow ray 4
#define PATH_RAY4_CACHE_LIGHT_R (PATH_END_5 + 15u) // of shadow ray 4
#define PATH_RAY4_CACHE_LIGHT_G (PATH_END_5 + 16u) // of shadow ray 4
#define PATH_RAY4_CACHE_LIGHT_B (PATH_END_5 + 17u) // of shadow ray 4
#define PATH_RAY4_GUIDE_LIGHT (PATH_END_5 + 18u) // of shadow ray 4
#define PATH_END_6 (PATH_END_5 + 19u)
#else
#define PATH_END_6 PATH_END_5
#endif
#if SHADOW_RAYS >= 5
#define PATH_RAY5_SHADOW_X (PATH_END_6 + 0u) // of shadow ray 5
#define PATH_RAY5_SHADOW_Y (PATH_END_6 + 1u) // of shadow ray 5
#define PATH_RAY5_SHADOW_Z (PATH_END_6 + 2u) // of shadow ray 5
#define PATH_RAY5_TOWARD_X (PATH_END_6 + 3u) // of shadow ray 5
#define PATH_RAY5_TOWARD_Y (PATH_END_6 + 4u) // of shadow ray 5
#define PATH_RAY5_TOWARD_Z (PATH_END_6 + 5u) // of shadow ray 5
#define PATH_RAY5_LIGHT_R (PATH_END_6 + 6u) // of shadow ray 5
#define PATH_RAY5_LIGHT_G (PATH_END_6 + 7u) // of shadow ray 5
#define PATH_RAY5_LIGHT_B (PATH_END_6 + 8u) // of shadow ray 5
#define PATH_RAY5_LIGHT_SHARE_R (PATH_END_6 + 9u) // of shadow ray 5
#define PATH_RAY5_LIGHT_SHARE_G (PATH_END_6 + 10u) // of shadow ray 5
#define PATH_RAY5_LIGHT_SHARE_B (PATH_END_6 + 11u) // of shadow ray 5
#define PATH_RAY5_BASE_LIGHT_R (PATH_END_6 + 12u) // of shadow ray 5
#define PATH_RAY5_BASE_LIGHT_G (PATH_END_6 + 13u) // of shadow ray 5
#define PATH_RAY5_BASE_LIGHT_B (PATH_END_6 + 14u) // of shadow ray 5
#define PATH_RAY5_CACHE_LIGHT_R (PATH_END_6 + 15u) // of shadow ray 5
#define PATH_RAY5_CACHE_LIGHT_G (PATH_END_6 + 16u) // of shadow ray 5
#define PATH_RAY5_CACHE_LIGHT_B (PATH_END_6 + 17u) // of shadow ray 5
#define PATH_RAY5_GUIDE_LIGHT (PATH_END_6 + 18u) // of shadow ray 5
#define PATH_END_7 (PATH_END_6 + 19u)
#else
#define PATH_END_7 PATH_END_6
#endif
#if SHADOW_RAYS >= 6
#define PATH_RAY6_SHADOW_X (PATH_END_7 + 0u) // of shadow ray 6
#define PATH_RAY6_SHADOW_Y (PATH_END_7 + 1u) // of shadow ray 6
#define PATH_RAY6_SHADOW_Z (PATH_END_7 + 2u) // of shadow ray 6
#define PATH_RAY6_TOWARD_X (PATH_END_7 + 3u) // of shadow ray 6
#define PATH_RAY6_TOWARD_Y (PATH_END_7 + 4u) // of shadow ray 6
#define PATH_RAY6_TOWARD_Z (PATH_END_7 + 5u) // of shadow ray 6
#define PATH_RAY6_LIGHT_R (PATH_END_7 + 6u) // of shadow ray 6
#define PATH_RAY6_LIGHT_G (PATH_END_7 + 7u) // of shadow ray 6
#define PATH_RAY6_LIGHT_B (PATH_END_7 + 8u) // of shadow ray 6
#define PATH_RAY6_LIGHT_SHARE_R (PATH_END_7 + 9u) // of shadow ray 6
#define PATH_RAY6_LIGHT_SHARE_G (PATH_END_7 + 10u) // of shadow ray 6
#define PATH_RAY6_LIGHT_SHARE_B (PATH_END_7 + 11u) // of shadow ray 6
#define PATH_RAY6_BASE_LIGHT_R (PATH_END_7 + 12u) // of shadow ray 6
#define PATH_RAY6_BASE_LIGHT_G (PATH_END_7 + 13u) // of shadow ray 6
#define PATH_RAY6_BASE_LIGHT_B (PATH_END_7 + 14u) // of shadow ray 6
#define PATH_RAY6_CACHE_LIGHT_R (PATH_END_7 + 15u) // of shadow ray 6
#define PATH_RAY6_CACHE_LIGHT_G (PATH_END_7 + 16u) // of shadow ray 6
#define PATH_RAY6_CACHE_LIGHT_B (PATH_END_7 + 17u) // of shadow ray 6
#define PATH_RAY6_GUIDE_LIGHT (PATH_END_7 + 18u) // of shadow ray 6
#define PATH_END_8 (PATH_END_7 + 19u)
#else
#define PATH_END_8 PATH_END_7
#endif
#if SHADOW_RAYS >= 7
#define PATH_RAY7_SHADOW_X (PATH_END_8 + 0u) // of shadow ray 7
#define PATH_RAY7_SHADOW_Y (PATH_END_8 + 1u) // of shadow ray 7
#define PATH_RAY7_SHADOW_Z (PATH_END_8 + 2u) // of shadow ray 7
#define PATH_RAY7_TOWARD_X (PATH_END_8 + 3u) // of shadow ray 7
#define PATH_RAY7_TOWARD_Y (PATH_END_8 + 4u) // of shadow ray 7
#define PATH_RAY7_TOWARD_Z (PATH_END_8 + 5u) // of shadow ray 7
#define PATH_RAY7_LIGHT_R (PATH_END_8 + 6u) // of shadow ray 7
#define PATH_RAY7_LIGHT_G (PATH_END_8 + 7u) // of shadow ray 7
#define PATH_RAY7_LIGHT_B (PATH_END_8 + 8u) // of shadow ray 7
#define PATH_RAY7_LIGHT_SHARE_R (PATH_END_8 + 9u) // of shadow ray 7
#define PATH_RAY7_LIGHT_SHARE_G (PATH_END_8 + 10u) // of shadow ray 7
#define PATH_RAY7_LIGHT_SHARE_B (PATH_END_8 + 11u) // of shadow ray 7
#define PATH_RAY7_BASE_LIGHT_R (PATH_END_8 + 12u) // of shadow ray 7
#define PATH_RAY7_BASE_LIGHT_G (PATH_END_8 + 13u) // of shadow ray 7
#define PATH_RAY7_BASE_LIGHT_B (PATH_END_8 + 14u) // of shadow ray 7
#define PATH_RAY7_CACHE_LIGHT_R (PATH_END_8 + 15u) // of shadow ray 7
#define PATH_RAY7_CACHE_LIGHT_G (PATH_END_8 + 16u) // of shadow ray 7
#define PATH_RAY7_CACHE_LIGHT_B (PATH_END_8 + 17u) // of shadow ray 7
#define PATH_RAY7_GUIDE_LIGHT (PATH_END_8 + 18u) // of shadow ray 7
#define PATH_END_9 (PATH_END_8 + 19u)
#else
#define PATH_END_9 PATH_END_8
#endif
#if SHADOW_RAYS >= 8
#define PATH_RAY8_SHADOW_X (PATH_END_9 + 0u) // of shadow ray 8
#define PATH_RAY8_SHADOW_Y (PATH_END_9 + 1u) // of shadow ray 8
#define PATH_RAY8_SHADOW_Z (PATH_END_9 + 2u) // of shadow ray 8
#define PATH_RAY8_TOWARD_X (PATH_END_9 + 3u) // of shadow ray 8
#define PATH_RAY8_TOWARD_Y (PATH_END_9 + 4u) // of shadow ray 8
#define PATH_RAY8_TOWARD_Z (PATH_END_9 + 5u) // of shadow ray 8
#define PATH_RAY8_LIGHT_R (PATH_END_9 + 6u) // of shadow ray 8
#define PATH_RAY8_LIGHT_G (PATH_END_9 + 7u) // of shadow ray 8
#define PATH_RAY8_LIGHT_B (PATH_END_9 + 8u) // of shadow ray 8
#define PATH_RAY8_LIGHT_SHARE_R (PATH_END_9 + 9u) // of shadow ray 8
#define PATH_RAY8_LIGHT_SHARE_G (PATH_END_9 + 10u) // of shadow ray 8
#define PATH_RAY8_LIGHT_SHARE_B (PATH_END_9 + 11u) // of shadow ray 8
#define PATH_RAY8_BASE_LIGHT_R (PATH_END_9 + 12u) // of shadow ray 8
#define PATH_RAY8_BASE_LIGHT_G (PATH_END_9 + 13u) // of shadow ray 8
#define PATH_RAY8_BASE_LIGHT_B (PATH_END_9 + 14u) // of shadow ray 8
#define PATH_RAY8_CACHE_LIGHT_R (PATH_END_9 + 15u) // of shadow ray 8
#define PATH_RAY8_CACHE_LIGHT_G (PATH_END_9 + 16u) // of shadow ray 8
#define PATH_RAY8_CACHE_LIGHT_B (PATH_END_9 + 17u) // of shadow ray 8
#define PATH_RAY8_GUIDE_LIGHT (PATH_END_9 + 18u) // of shadow ray 8
#define PATH_END_10 (PATH_END_9 + 19u)
#else
#define PATH_END_10 PATH_END_9
#endif
#if BASE >= 1
#define PATH_BASE_R (PATH_END_10 + 0u) // of what goes to the pixel, what the base of the first surface reflected
#define PATH_BASE_G (PATH_END_10 + 1u)
#define PATH_BASE_B (PATH_END_10 + 2u)
#define PATH_END_11 (PATH_END_10 + 3u)
#else
#define PATH_END_11 PATH_END_10
#endif
#if BASE >= 2
#define PATH_BASE_SHARE_R (PATH_END_11 + 0u) // part of what comes from beyond that surface that its base reflects
#define PATH_BASE_SHARE_G (PATH_END_11 + 1u)
#define PATH_BASE_SHARE_B (PATH_END_11 + 2u)
#define PATH_BASE_LIGHT_R (PATH_END_11 + 3u) // the same of the shadow ray
#define PATH_BASE_LIGHT_G (PATH_END_11 + 4u)
#define PATH_BASE_LIGHT_B (PATH_END_11 + 5u)
#define PATH_END_12 (PATH_END_11 + 6u)
#else
#define PATH_END_12 PATH_END_11
#endif
#if CELLS >= 1
#define PATH_VERTEX (PATH_END_12 + 0u) // uint; 1 + depth of the vertex behind which light is shared, its face; 0: none
#define PATH_LENGTH (PATH_END_12 + 1u) // m, from the camera on
#define PATH_BEYOND_R (PATH_END_12 + 2u) // of what was gathered, what is shared: it came from beyond that vertex
#define PATH_BEYOND_G (PATH_END_12 + 3u)
#define PATH_BEYOND_B (PATH_END_12 + 4u)
#define PATH_END_13 (PATH_END_12 + 5u)
#else
#define PATH_END_13 PATH_END_12
#endif
#if CELLS >= 2
#define PATH_SHARE_R (PATH_END_13 + 0u) // part of what comes from beyond the vertex that is shared
#define PATH_SHARE_G (PATH_END_13 + 1u)
#define PATH_SHARE_B (PATH_END_13 + 2u)
#define PATH_LIGHT_SHARE_R (PATH_END_13 + 3u) // the same of the shadow ray
#define PATH_LIGHT_SHARE_G (PATH_END_13 + 4u)
#define PATH_LIGHT_SHARE_B (PATH_END_13 + 5u)
#define PATH_END_14 (PATH_END_13 + 6u)
#else
#define PATH_END_14 PATH_END_13
#endif
#if CACHE >= 1
#define PATH_CACHE (PATH_END_14 + 0u) // uint; cell that the path learns for; NO_SLOT: none
#define PATH_CACHE_GATE_R (PATH_END_14 + 1u) // part of light from here that it reflects, over its reflectance
#define PATH_CACHE_GATE_G (PATH_END_14 + 2u)
#define PATH_CACHE_GATE_B (PATH_END_14 + 3u)
#define PATH_CACHE_LIGHT_R (PATH_END_14 + 4u) // what arrives through the shadow ray, by the same measure
#define PATH_CACHE_LIGHT_G (PATH_END_14 + 5u)
#define PATH_CACHE_LIGHT_B (PATH_END_14 + 6u)
#define PATH_END_15 (PATH_END_14 + 7u)
#else
#define PATH_END_15 PATH_END_14
#endif
#if GUIDE >= 1
#define PATH_GUIDE (PATH_END_15 + 0u) // uint; part of the guide's cell that the ray left through; NO_PART: none
#define PATH_GUIDE_FROM (PATH_END_15 + 1u) // uint; that of the ray before the shadow ray
#define PATH_EXPECTED (PATH_END_15 + 2u) // luminance at the camera that the first vertex was expected to reflect
#define PATH_GUIDE_LIGHT (PATH_END_15 + 3u) // luminance that arrives through the shadow ray, reflected along that
#define PATH_END_16 (PATH_END_15 + 4u)
#else
#define PATH_END_16 PATH_END_15
#endif
#define PATH_FIELD_COUNT PATH_END_16

#define CHAIN_KNOWN 0u // uint; pairs of numbers of the state from which the path starts; 0: a large step
#define CHAIN_PAIRS 1u // uint; pairs of numbers that the state has
#define CHAIN_PATHS 2u // uint; paths that have come to their end
#define CHAIN_PASS 3u // uint; the pass that the next path counts to
#define CHAIN_PLACE 4u // uint; its place in it
#define CHAIN_RADIANCE_R 5u // of the state
#define CHAIN_RADIANCE_G 6u
#define CHAIN_RADIANCE_B 7u
#define CHAIN_PIXEL 8u // uint; of the state, position in the order of pixels
#define CHAIN_INDEPENDENT 9u // luminance of the paths after large steps, summed
#define CHAIN_LOST 10u // what that sum lost by rounding
#define CHAIN_LARGE 11u // uint; large steps
#define CHAIN_LARGE_ACCEPTED 12u // uint
#define CHAIN_SMALL 13u // uint; small steps
#define CHAIN_SMALL_ACCEPTED 14u // uint
#define CHAIN_FIELD_COUNT 15u

#define COUNTER_NEXT_PIXEL 0u // next pixel to be started, counted from the first pixel of next_pass
#define COUNTER_NEXT_PASS 1u // pass that next_pixel 0 belongs to
#define COUNTER_FILM_PASS 2u // passes that the film holds
#define COUNTER_PASS_LIMIT 3u // first pass that must not be started; set by the host
#define COUNTER_CAMERA_RAYS 4u // low word
#define COUNTER_CAMERA_RAYS_HIGH 5u // high word
#define COUNTER_BOUNCE_RAYS 6u // low word
#define COUNTER_BOUNCE_RAYS_HIGH 7u // high word
#define COUNTER_SHADOW_RAYS 8u // low word
#define COUNTER_SHADOW_RAYS_HIGH 9u // high word
#define COUNTER_REJECTED_SAMPLES 10u // samples that were not finite, or too large to be summed
#define COUNTER_FAILED_INSERTS 11u // low word; samples that found their part of the table of cells full
#define COUNTER_FAILED_INSERTS_HIGH 12u // high word
#define COUNTER_REJECTED_CELLS 13u // low word; samples too large for the sums of a cell
#define COUNTER_REJECTED_CELLS_HIGH 14u // high word
#define COUNTER_FAILED_HISTORIES 15u // low word; cells of passes that the cells' history had no room for
#define COUNTER_FAILED_HISTORIES_HIGH 16u // high word
#define COUNTER_UNFILTERED_SAMPLES 17u // low word; samples that looked for a cell and found none
#define COUNTER_UNFILTERED_SAMPLES_HIGH 18u // high word
#define COUNTER_CELLS_USED 19u // low word; cells with samples, summed over passes
#define COUNTER_CELLS_USED_HIGH 20u // high word
#define COUNTER_CELL_PROBES 21u // low word; slots looked at to find each of these once
#define COUNTER_CELL_PROBES_HIGH 22u // high word
#define COUNTER_CHAIN_LIMIT 23u // first path of a chain that must not be started; set by the host
#define COUNTER_CHAIN_STARTS 24u // paths of chains that ended before the first pass
#define COUNTER_DARK_SAMPLES 25u // low word; samples that gathered no light
#define COUNTER_DARK_SAMPLES_HIGH 26u // high word
#define COUNTER_GUIDE_FAILED 27u // vertices that found their part of the table of the guide full
#define COUNTER_GUIDE_REJECTED 28u // what is not finite, or too large for the sums of the guide
#define COUNTER_GUIDE_OFF 29u // 1 if the guide does not pay here, and is left out; set by the host
#define COUNTER_LEARN_LIMIT 30u // first pass that the guide learns nothing from; set by the host
#define COUNTER_CACHE_FAILED 31u // vertices that found their part of the table of the radiance cache full
#define COUNTER_CACHE_REJECTED 32u // what is not finite, or too large for the sums of the radiance cache
#define COUNTER_CACHE_ENDS 33u // low word; paths that ended by the radiance cache
#define COUNTER_CACHE_ENDS_HIGH 34u // high word
#define COUNTER_MATERIAL_FAILED 35u // vertices that found their part of the parameter cloud full
#define COUNTER_PENDING_CAMERA 36u // rays since the last film launch
#define COUNTER_PENDING_BOUNCE 37u
#define COUNTER_PENDING_SHADOW 38u
#define COUNTER_FINISHED 39u // first of the ring: samples done of each pass in flight

#define PHOTONS_EMITTED 0u // with any power, also one that is not finite
#define PHOTONS_DARK 1u // drawn where their light gives none
#define PHOTONS_ESCAPED 2u // left the scene
#define PHOTONS_STORED 3u // deposits in the map
#define PHOTONS_ABSORBED 4u // ended at a surface that reflected no more; of those that go on
#define PHOTONS_CUT 5u // ended by the limit of bounces; of those that go on
#define PHOTONS_REJECTED 6u // ended with a power that is not finite

/// Everything that is the same for all paths of a render.
typedef struct {
    float camera_origin[3]; // world, m
    float lens_radius; // m
    float camera_right[3]; // unit, world
    float focus_distance; // m
    float camera_up[3]; // unit, world
    float film_scale_x; // tangent of half the field of view; of parallel rays, m
    float camera_forward[3]; // unit, world
    float film_scale_y; // the same upwards
    uint width; // pixels of the whole film
    uint height; // pixels of the whole film
    uint pixel_count; // pixels that are rendered
    uint crop_x; // first column that is rendered
    uint crop_y; // first row that is rendered
    uint crop_width; // columns that are rendered
    uint crop_height; // rows that are rendered
    uint ring; // passes that may be in flight
    uint slots; // paths of the pool
    uint seed; // start of every random sequence
    uint max_depth; // bounces
    uint splits; // samples in a row whose paths begin alike
    uint split_vertex; // where these part, 1 for the first surface seen
    uint roulette_depth; // bounces before roulette
    uint light_count; // entries of the light table
    uint environment_light; // index of the environment in it
    uint node_bits; // that a node of the tree of lights takes
    uint particle_cells; // of the map of photons, a power of two
    float particle_cell; // edge of a cell, m per m from the camera
    float virtual_clearance; // radii of the scene; nearer virtual lights are no brighter
    uint shadow_rays; // of each vertex; 0: as many as its photons ask for
    float photon_floor; // chance that a light is drawn whatever photons say
    uint environment_width; // texels
    uint environment_height; // texels
    float environment_radiance[3]; // constant sky, or factor of the image
    float environment_rotation[9]; // world to local, row-major
    float scene_radius; // m, of the bounding sphere
    float scene_center[3]; // of it; world, m
    uint direct_sampling; // DIRECT_MIS, DIRECT_LIGHT or DIRECT_BSDF
    uint sampler; // SAMPLER_SOBOL or SAMPLER_RANDOM
    uint corner_count; // of the list of corners, where all triangles are tested
    uint face_count; // triangles between those corners
    uint plate_count; // flat pieces that these make; 0: only corner by corner
    uint pair_count; // plates, the first ones, that are parallelograms
    uint cell_min_count; // samples below which a cell gives way to a wider one
    uint cell_slots; // of the table of cells of one pass, a power of two
    uint cell_flags; // CELL_JITTER, CELL_NEAR, CELL_IDENTITY
    float cell_width; // edge of a cell in the first pass, m per m of the path
    uint cell_directions; // parts of directions that cells of gloss tell apart, a side
    float cell_alpha; // least GGX alpha of coats and metals that share at the first surface
    float cell_shrink; // exponent of the number of the pass in the edge of a cell
    float cell_steps; // fixed-point steps of a sum of radiance per unit, a power of two
    float cell_limit; // radiance from which a sample is too large for the sums
    uint filter_vertex; // first vertex whose light may be shared; FILTER_AUTO, FILTER_NONE
    uint filter_direct; // whether light that falls on it directly is shared too
    float sky_limit; // luminance up to which light of the sky is shared anyway; below 0: none
    float screen_radius; // pixels; the screen filter's neighbours of a pixel's first sample
    uint screen_neighbours; // of a pixel, that the screen filter asks
    uint temporal_rule; // RULE_OFF, RULE_EXPONENTIAL, RULE_CUMULATIVE or RULE_ADAPTIVE
    float temporal_alpha; // weight of a frame, by the exponential rule
    float cell_history; // s, for which cells keep light that nobody sees
    float frame_time; // s, of this frame
    uint history_flags; // HISTORY_THERE, HISTORY_STILL, HISTORY_SAME_VIEW, HISTORY_CHANGED
    uint first_moving; // the first triangle that moves: all after it do
    uint first_pass; // of this frame; passes are counted on from frame to frame
    float previous_origin[3]; // of the camera of the frame before; world, m
    float previous_right[3]; // unit, world
    float previous_up[3]; // unit, world
    float previous_forward[3]; // unit, world
    float previous_scale_x; // tangent of half the horizontal field of view
    float previous_scale_y; // tangent of half the vertical field of view
    uint chain_start; // independent paths of each chain, before the first state
    uint chain_pairs; // pairs of random numbers that a chain keeps
    uint chain_numbers; // words from those of a chain to those of the next
    float large_steps; // chance of a path of new random numbers
    float splat_steps; // fixed-point steps of a splat as bright as the mean, a power of two
    uint guide_slots; // of the table of the guide, a power of two
    float guide_width; // edge of its cells, m per m from the camera
    float guide_least; // edge of the smallest of them, m
    float guide_most; // edge of the largest, m
    float guide_share; // of the directions of a diffuse lobe that the guide draws
    float guide_steps; // fixed-point steps of a sum of its radiance per unit, a power of two
    float guide_limit; // radiance from which a sample is too large for these sums
    uint cache_slots; // of the table of the radiance cache, a power of two
    float cache_width; // edge of its cells, m per m from the camera
    float cache_steps; // fixed-point steps of a sum of radiance per unit, a power of two
    float cache_limit; // radiance from which a sample is too large for these sums
    float cache_trace; // least chance that a path goes on where a cell is known
    uint material_slots; // of the table of the parameter cloud, a power of two
    float material_width; // edge of its cells, m per m from the camera
} Params;

/// Eight children of an inner node; 256 bytes, so that a node fills whole cache lines.
typedef struct {
    float bounds[6][8]; // x low, x high, y low ... of each child; an empty one is inverted
    uint child[8]; // node index, or LEAF_BIT | block index
    uint unused[8]; // fills the cache line
} BvhNode;

/// A leaf: up to four triangles side by side; an unused one is all NaN.
typedef struct {
    float v[9][4]; // vertex * 3 + axis; world, m
    uint id[4]; // triangle index, ALPHA_BIT set if its alpha must be looked up
} TriangleBlock;

/// A flat piece of a small scene's list: two triangles that make a parallelogram, or one.
typedef struct {
    float u[4]; // of a point (p, 1): how far it is along the first edge, of 1
    float v[4]; // the same along the second
    float n[4]; // how far it is off the plane, m
    float slack; // by which u and v may be wrong for each meter from the origin
    float slack_here; // the same for the plate's own distance
    uint first; // triangle where u + v < 1, with ALPHA_BIT; its corner at u = v = 0 << PLATE_TURN
    uint second; // the other one; its corner at u = v = 1 << PLATE_TURN
} Plate;

/// A node of the binary tree that the wide nodes are made from; one cache line.
typedef struct {
    float low[3]; // of its box; the scene's largest extent is 1
    uint left; // child; of a leaf its triangle
    float high[3]; // of its box
    uint right; // child; of a leaf LEAF_BIT
    float costs[7]; // least cost of the subtree as at most 1 .. 7 children of a wide node
    uint size; // triangles below; LEAF_BIT set if they are best kept as one block
} BinaryNode;

/// A triangle as shading needs it; one cache line.
typedef struct {
    float p0[3]; // first vertex; world, m
    uint material; // index into the materials
    float e1[3]; // second vertex minus first
    uint light; // index into the light table, NO_LIGHT if it does not emit
    float e2[3]; // third vertex minus first
    float offset; // m along ng that clears the rounding error of a point on it
    float ng[3]; // unit normal of the front side
    uint shape; // number of its shape among those that are visible
} Surface;

/// A placing of a mesh that has a tree of its own; two cache lines.
typedef struct {
    float x_row[3]; // of the matrix from the mesh to the world
    uint base; // index of a hit minus that of its triangle
    float y_row[3]; // second row
    uint root; // node where the mesh's tree begins
    float z_row[3]; // third row
    uint material; // of all triangles, or OWN_MATERIAL
    float position[3]; // of the mesh's origin; world, m
    float offset; // m along ng that clears the rounding error of any point; 0: the triangles' own
    float inverse[9]; // from the world to the mesh, without position, row by row
    float mirroring; // -1 if the mesh is mirrored, else 1
    uint pad[2]; // fills the record
} Instance;

/// A vertex that moves, in its own space.
typedef struct {
    float p[3]; // m
    uint first_delta; // of its morph targets
    float n[3]; // unit shading normal; zero if it is flat
    uint delta_count; // morph targets
    float t[4]; // tangent and sign; zero if it has none
} RestVertex;

/// What a morph target adds to a vertex, times its weight.
typedef struct {
    float p[3]; // m
    uint weight; // index into the weights
    float n[3]; // of the normal
    float pad0; // fills the word
    float t[3]; // of the tangent
    float pad1; // fills the record
} MorphDelta;

/// A vertex where it is in this frame.
typedef struct {
    float p[3]; // world, m
    float side; // -1 if it is mirrored, else 1
    float n[3]; // unit shading normal; zero if it has none
    float pad; // fills the word
    float t[4]; // unit tangent and sign
} MovedVertex;

/// Where the corners of a triangle that moves were in the frame before.
typedef struct {
    float p[9]; // corner * 3 + axis; world, m
    float pad[3]; // fills the record
} Corners;

/// Shading normals of a triangle's corners; all zero if it is flat.
typedef struct {
    float n0[3]; // unit, world
    float pad0; // fills the word
    float n1[3]; // unit, world
    float pad1; // fills the word
    float n2[3]; // unit, world
    float pad2; // fills the word
} Normals;

/// Texture coordinates of a triangle's corners.
typedef struct {
    float uv0[2]; // first corner
    float uv1[2]; // second corner
    float uv2[2]; // third corner
    float density; // area in coordinates over area, 1/m^2
    float pad; // fills the record
} Uvs;

/// Colours of a triangle's corners; they multiply the base colour.
typedef struct {
    float c0[4]; // linear Rec.709 and alpha
    float c1[4]; // linear Rec.709 and alpha
    float c2[4]; // linear Rec.709 and alpha
} VertexColors;

/// Directions of growing u at a triangle's corners; all zero if it has none.
typedef struct {
    float t0[4]; // unit, world; then 1 or -1: the bitangent is that times normal x tangent
    float t1[4]; // unit, world; the same
    float t2[4]; // unit, world; the same
} Tangents;

/// Parameters of the one BSDF; textures are indices, NO_TEXTURE for none.
typedef struct {
    float base_color[3]; // linear Rec.709
    float metallic; // 0 dielectric, 1 metal
    float emission[3]; // radiance
    float roughness; // its square is the alpha of GGX
    float f0; // dielectric reflectance at normal incidence, before the specular strength
    float specular; // strength of the dielectric reflection; 0 for pure diffuse
    float ior; // index of refraction
    float transmission; // 0 opaque, 1 glass
    uint base_color_texture; // colour and alpha
    uint emission_texture; // colour
    uint metallic_roughness_texture; // roughness in green, metallic in blue
    uint flags; // MATERIAL_* bits
    float alpha; // opacity, before textures
    float alpha_cutoff; // least opacity that is there, of a mask
    uint normal_texture; // tangent space
    float normal_scale; // of its x and y
    float absorption[3]; // per m, inside
    uint transmission_texture; // red
    float specular_color[3]; // linear Rec.709; tints the dielectric reflection
    uint specular_texture; // alpha
    uint specular_color_texture; // colour
    float clearcoat; // strength of the coat
    float clearcoat_roughness; // its square is the alpha of GGX
    uint clearcoat_texture; // red
    float sheen_color[3]; // linear Rec.709
    float sheen_roughness; // its square is the alpha of the Charlie distribution
    uint clearcoat_roughness_texture; // green
    uint sheen_color_texture; // colour
    uint sheen_roughness_texture; // alpha
    float anisotropy; // 0 to 1
    float anisotropy_direction[2]; // cosine and sine of the rotation from the tangent
    uint anisotropy_texture; // direction in red and green, strength in blue
    float pad[5]; // fills the cache line
} Material;

/// Where a texture's texels are, and how coordinates come to them.
typedef struct {
    uint offset; // first texel
    uint width; // texels
    uint height; // texels
    uint flags; // TEXTURE_* bits: wrap of u and v, nearest, sRGB
    float matrix[6]; // rows of the transform of (u, v, 1)
    uint uv_offset; // to be added to a triangle's index, for its set of coordinates
    uint smaller; // of its levels of half the size and less, the first; 0 for none
} TextureInfo;

/// An emitter of the light table, with all that sampling it needs; two cache lines.
typedef struct {
    uint kind; // LIGHT_TRIANGLE, LIGHT_ENVIRONMENT, LIGHT_POINT, LIGHT_SPOT or LIGHT_DIRECTIONAL
    uint triangle; // index, for LIGHT_TRIANGLE
    float pmf; // chance to be picked
    float keep; // alias table: chance that the slot keeps its own index
    float position[3]; // world, m; of a triangle the first corner, of a sphere the center
    uint other; // alias table: the index otherwise
    float direction[3]; // unit, the way of its light; of a triangle the front's normal, of a sphere y
    float range; // m, inf for none
    float intensity[3]; // candela, lux, or a triangle's radiance
    float cos_outer; // of the cone
    float e1[3]; // of a triangle, second corner minus first; of a sphere its x axis, m
    float spot_scale; // 1 / (cos inner - cos outer), floored
    float e2[3]; // of a triangle, third corner minus first; of a sphere its z axis, m
    float area; // m^2, of a triangle
    float offset; // of a triangle, as Surface.offset
    uint emission_texture; // index, NO_TEXTURE for none
    uint flags; // of the material; LIGHT_RECTANGLE, with LIGHT_DISK or not, or LIGHT_SPHERE
    float power; // candela along its brightest direction, or lux from infinitely far
    float pad[4]; // fills the record
} Light;

/// Two sibling nodes of the tree of lights; one cache line.
typedef struct {
    float center[2][3]; // of a sphere around the lights; world, m
    float radius[2]; // m; infinite: `power` is the weight wherever it is asked for
    float power[2]; // of all its lights, as Light.power, in any one unit
    float cos_spread[2]; // of the angle between the axis and any direction that a light faces
    uint axis[2]; // mean direction that the lights face, octahedral, 16 bits a coordinate
    uint child[2]; // index of a pair, or LEAF_BIT | a light, GROUP_BIT, CLUSTER_BIT; or NO_LIGHT
} LightPair;

/// The subtree of lights around a light that photons do not tell apart.
typedef struct {
    uint node; // 2 * pair + side in the tree; NO_LIGHT for none
    float chance; // that the table of lights draws one of its lights
    uint pad[2]; // fills the record
} LightGroup;

/// Where a photon came to, as a light.
typedef struct {
    float p[3]; // world, m; off the surface
    uint ng; // geometric normal, octahedral, 16 bits a coordinate
    float power[3]; // radiant flux that its diffuse base reflects, times the photons drawn
    float pad; // fills the record
} VirtualLight;

/// What both nodes of a LightPair have in common, to fit their parent.
typedef struct {
    float low[3]; // world, m
    float power; // as in LightPair
    float high[3]; // world, m
    float spread; // radians, as in LightPair
    float axis[3]; // unit
    uint far; // whether one of the lights is infinitely far
} LightBounds;

/// A texel of the environment: radiance and its slot of the alias table.
typedef struct {
    float radiance[3]; // before the factor
    float pmf; // chance of the texel
    float keep; // alias table
    uint other; // alias table
    float pad[2]; // fills the record
} EnvironmentCell;

/// All samples of one pixel of one plane.
typedef struct {
    float sum[3]; // of the values
    uint count; // samples
    float lost[3]; // what the sums lost by rounding
    float mean; // running mean of the luminance
    float squares; // sum of squared deviations from it
    float lost_squares; // what that sum lost by rounding
    float pad[2]; // fills the record
} FilmSum;

/// The first surface that a sample sees.
typedef struct {
    float p[3]; // world, m
    uint shape; // 1 + its number, SHAPE_MOVES, SHAPE_SHINES; 0 if nothing is seen
    float ns[3]; // unit, shading normal
    float gate[3]; // throughput there, times the reflectance of the diffuse base
    float share[3]; // part of what comes from beyond it, or its cell, that its base reflects
    float before[3]; // where it was in the frame before
} Seen;

/// The first surface that a pixel sees: means over its samples.
typedef struct {
    float p[3]; // world, m
    uint hits; // samples that see a surface; p, ns and before are theirs
    float ns[3]; // of the shading normals
    uint count; // samples
    float gate[3]; // of all samples: 0 where one sees nothing
    uint shape; // of the first sample; SHAPE_SHINES of any
    float before[3]; // where it was in the frame before
    float pad; // fills the record
} SeenMean;

/// Light of a pixel as the film and its history have it, before the screen filter.
typedef struct {
    float rgb[3]; // radiance
    float count; // samples that it is worth
    float base[3]; // of that, what the diffuse base of the first surface reflected
    float alpha; // weight that this frame has in it
    float square; // mean of the squared luminance of frames, or of the samples of one
    float change; // of the light since the frame before, 0 to 1
    float noise; // variance of the luminance of `base`, NOISE_UNKNOWN where nothing can be told
    float means; // how many, samples or frames, `square` is of
} PixelLight;

/// A pixel of the frame before: its light and what it sees.
typedef struct {
    float rgb[3]; // radiance
    float count; // samples that it is worth; 0 if there is none
    float base[3]; // of that, what the diffuse base of the first surface reflected
    uint shape; // as SeenMean.shape
    float p[3]; // world, m
    float square; // mean of the squared luminance of frames
    float ns[3]; // unit, shading normal
    float pad; // fills the record
} History;

/// A path from a surface that is traced again in the next frame.
typedef struct {
    uint triangle; // of its vertex; NO_HIT if there is none
    float u; // barycentric coordinate there
    float v; // barycentric coordinate there
    uint seed; // of the points on its lights
    float direction[3]; // unit, in which it goes on
    uint light; // of its vertex
    float wo[3]; // unit, from where it was seen
    uint next_light; // of the surface that it goes on to
    float pmf; // chance that the light had
    float next_pmf; // the same of the next
    float reflected[2]; // luminance that its surfaces reflected in the frame before, and in this one
    float emitted[2]; // luminance that its vertex gave away itself, in both
    float pad[2]; // fills the record
} Probe;

/// The vertex of a sample behind which light is shared.
typedef struct {
    float p[3]; // world, m
    uint ng; // geometric normal, octahedral, 16 bits a coordinate
    float gate[3]; // throughput from the camera, times the reflectance that was taken out
    float length; // m, of the path up to here
} CellVertex;

/// What a sample gathered behind its cell's vertex.
typedef struct {
    float radiance[3]; // at the camera
    uint vertex; // 1 + its depth, VERTEX_NEAR, VERTEX_REJECTED, a face, a wall; 0 if there is none
} Beyond;

/// What averages per cell took from a pixel: sums over its samples, or a mean and its variance.
typedef struct {
    float rgb[3]; // its own radiance minus that of the averages
    float difference; // of its luminance between two halves of the samples; of a mean its variance
} Lost;

/// What a cell gathers: 64-bit fixed-point sums.
typedef struct {
    uint low[3]; // of radiance; from resolve_cells on the bits of their mean, a float
    uint count; // samples
    uint high[3]; // of radiance
    uint change; // of the light since the frame before, the bits of a float
} Cell;

/// What a cell knows from the frames before, and what it gathers in this one.
typedef struct {
    float mean[3]; // radiance behind the vertices in it
    float count; // samples that it is worth; 0 if there was no frame before
    float sum[3]; // of the samples of this frame
    float fresh; // these samples
    float square; // mean of the squared luminance of frames
    float frames; // frames that it is worth
    float seen; // s, time of the last frame with samples in it
    float change; // of the light since the frame before, 0 to 1
} CellHistory;

/// What the samples of a pixel took from cells: sums over them.
typedef struct {
    float fresh[3]; // radiance, by the averages of this frame
    float frames; // that what was known of these cells is worth
    float known[3]; // radiance, by what was known of them
    float samples; // that found a cell
    float base[3]; // of that, what the diffuse base of the first surface reflected
    float unused; // fills the record
} SharedLight;

/// A pixel's own part of what it shows of cells, and what they add from before it was seen.
typedef struct {
    float mean[3]; // radiance from cells, over the frames that the pixel knows
    float count; // samples that the pixel is worth by itself
    float older[3]; // the same by what cells knew before each of these frames
    float pad; // fills the record
    float added[3]; // radiance
    float spare; // fills the record
    float base[3]; // of that, what the diffuse base of the first surface reflected
    float unused; // fills the record
} SharedPixel;

/// The second moment of a cell: a 64-bit fixed-point sum.
typedef struct {
    uint low; // of (luminance / cell_limit)^2; from resolve_cells on a float's bits: the variance
    uint high; // of the same
    uint unused[2]; // fills 16 bytes
} CellSquares;

/// What the samples of a pixel saw of cells: sums over its samples.
typedef struct {
    float color[3]; // of the cell of the first pass, made of its key; not a sum
    float occupancy; // part of its bucket's slots that are taken
    float count; // samples in it
    float variance; // of their luminance
    float weight; // 1 for a sample that used a cell's average
    float pad; // fills the record
} CellView;

/// What the paths of a pass brought to a pixel: 64-bit fixed-point sums.
typedef struct {
    uint low[3]; // of radiance
    uint high[3]; // of radiance
    uint pad[2]; // fills the record
} SplatSum;

/// What a cell of the radiance cache gathers: 64-bit fixed-point sums.
typedef struct {
    uint low[4]; // of rgb over the reflectance; of the squared luminance over the mean
    uint high[4]; // of the same
    uint count; // visits
    uint near; // of these, by paths that came from nearer than its edge
    uint pad[2]; // fills the record
} CacheSum;

/// What a cell of the radiance cache knows, the same for a whole epoch.
typedef struct {
    float mean[3]; // radiance that a white diffuse surface reflects there
    float ends; // chance that a path ends there
    float visits; // that it is made from; 0: nothing is known
    float pad[3]; // fills the record
} CacheCell;

/// What a cell of the parameter cloud gathers: 64-bit fixed-point sums.
typedef struct {
    uint low[5]; // of what textures gave: rgb of the base colour, roughness, metallic
    uint high[5]; // of the same
    uint count; // vertices that looked it up
    uint pad; // fills the record
} MaterialSum;

/// What a cell of the parameter cloud knows, the same for a whole epoch.
typedef struct {
    float color[3]; // factor of the base colour that textures give
    float roughness; // of the roughness
    float metallic; // of the metallic part
    uint visits; // that it is made from; 0: nothing is known
    uint pad[2]; // fills the record
} MaterialCell;

/// What a cell of the guide gathers: 64-bit fixed-point sums of each part of the hemisphere.
typedef struct {
    uint low[64]; // of radiance
    uint high[64]; // of radiance
    uint count[64]; // visits
} GuideSum;

/// What paths are drawn by at a cell of the guide, the same for a whole epoch.
typedef struct {
    float density[64]; // of each part, over that of the cosine, row by row
    float rows[8]; // share of all rows up to this
    float mean; // over the parts: what a white diffuse surface reflects of what no shadow ray finds
    float visits; // that it is made from; 0: nothing is known
    float pad[6]; // fills the record
} GuideCell;

/// What the guide knows at what a pixel sees.
typedef struct {
    float direction[3]; // mean of those that it draws, world; 0 where nothing is known
    float entropy; // of the parts of the hemisphere that they are in, bits
    float visits; // that its cells are made from
    float pad[3]; // fills the record
} GuideView;
