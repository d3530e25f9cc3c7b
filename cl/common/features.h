// What a scene may need: each is defined by the plan, also when it is 0.
#pragma once

#if !defined(W) || !defined(BLOCK) || !defined(RUN)
#error "W, BLOCK and RUN must be defined"
#endif
#ifndef TEXTURES
#error "TEXTURES must be 0 or 1"
#endif
#ifndef TEXTURE_LEVELS
#error "TEXTURE_LEVELS must be 0 or 1 (later vertices look up smaller textures)"
#endif
#ifndef ALPHA
#error "ALPHA must be 0 (none), 1 (masks) or 2 (also blending)"
#endif
#ifndef BACK_FACES
#error "BACK_FACES must be 0 or 1 (the camera looks through some)"
#endif
#ifndef VERTEX_COLORS
#error "VERTEX_COLORS must be 0 or 1"
#endif
#ifndef TANGENTS
#error "TANGENTS must be 0 or 1"
#endif
#ifndef SMOOTH
#error "SMOOTH must be 0 or 1"
#endif
#ifndef GLOSSY
#error "GLOSSY must be 0 or 1"
#endif
#ifndef TRANSMISSION
#error "TRANSMISSION must be 0 or 1"
#endif
#ifndef LAYERS
#error "LAYERS must be 0 or 1"
#endif
#ifndef AREA_LIGHTS
#error "AREA_LIGHTS must be 0 or 1"
#endif
#ifndef RECTANGLES
#error "RECTANGLES must be 0 or 1 (some area lights are)"
#endif
#ifndef SPHERES
#error "SPHERES must be 0 or 1 (some area lights are)"
#endif
#ifndef PUNCTUAL_LIGHTS
#error "PUNCTUAL_LIGHTS must be 0 or 1"
#endif
#ifndef ENVIRONMENT
#error "ENVIRONMENT must be 0 (none), 1 (constant) or 2 (image)"
#endif
#ifndef CONNECT
#error "CONNECT must be 0 or 1"
#endif
#ifndef LIGHT_SAMPLING
#error "LIGHT_SAMPLING must be 0 (a table of chances), 1 (a tree), 2 (photons) or 3 (where photons started)"
#endif
#define LIGHT_PHOTONS (LIGHT_SAMPLING >= 2)
#define PHOTON_POINTS (LIGHT_SAMPLING == 3)
#ifndef VIRTUAL_LIGHTS
#error "VIRTUAL_LIGHTS must be 0 or 1 (photons stand for reflected light)"
#endif
#ifndef SHADOW_RAYS
#error "SHADOW_RAYS must be 0 (one at a vertex) or how many at most"
#endif
#ifndef LENS
#error "LENS must be 0 (a pinhole), 1 (a lens) or 2 (parallel rays)"
#endif
#ifndef MOTION
#error "MOTION must be 0 or 1"
#endif
#ifndef AOV_DIRECT
#error "AOV_DIRECT must be 0 or 1"
#endif
#ifndef AOV_LIGHTS
#error "AOV_LIGHTS must be 0, 1 (chances of lights) or 2 (and what photons know)"
#endif
#ifndef AOV_FEATURES
#error "AOV_FEATURES must be 0 or 1"
#endif
#ifndef SEEN
#error "SEEN must be 0, 1 (the first surface is kept) or 2 (and where it was)"
#endif
#ifndef TEMPORAL
#error "TEMPORAL must be 0, 1 (frames share light) or 2 (and look for changes)"
#endif
#ifndef CELL_HISTORY
#error "CELL_HISTORY must be 0, 1 (cells keep what they know from frame to frame) or 2 (and ask for changes)"
#endif
#ifndef BASE
#error "BASE must be 0, 1 (what the first surface reflects is kept apart) or 2 (only what its base reflects)"
#endif
#ifndef FEW
#error "FEW must be 0 (a tree), or the most corners of the list of triangles"
#endif
#ifndef INSTANCES
#error "INSTANCES must be 0, or the bits of a hit's index below the number of the instance"
#endif
#ifndef GUIDE
#error "GUIDE must be 0 or 1"
#endif
#ifndef CACHE
#error "CACHE must be 0 or 1 (paths end where a cell knows what a surface reflects)"
#endif
#ifndef CELLS
#error "CELLS must be 0, 1 (all of a vertex's light is shared) or 2 (a part of it)"
#endif
#ifndef MATERIAL_CELLS
#error "MATERIAL_CELLS must be 0 or 1 (later vertices fetch what textures give once a cell)"
#endif
#ifndef CELL_LAYERS
#error "CELL_LAYERS must be 0 or 1 (what coats and metals reflect is shared where it is wide)"
#endif
#ifndef AOV_BOUNCES
#error "AOV_BOUNCES must be 0 or 1"
#endif
#ifndef AOV_GUIDE
#error "AOV_GUIDE must be 0 or 1"
#endif
#ifndef AOV_CELLS
#error "AOV_CELLS must be 0 or 1"
#endif
#ifndef SPARSE
#error "SPARSE must be 0 or 1 (cells with few samples give way to wider ones)"
#endif
#ifndef WALLS
#error "WALLS must be 0 or 1 (walls inside cells keep light apart)"
#endif
#ifndef RESTORE
#error "RESTORE must be 0 or 1 (what averages per cell take from a pixel is kept apart)"
#endif
#ifndef FIREFLIES
#error "FIREFLIES must be 0 or 1 (pixels that few samples speak for are dimmed)"
#endif
#ifndef METROPOLIS
#error "METROPOLIS must be 0 or 1 (paths are those of chains)"
#endif
