"""Records shared with the device: listed once here; ``cl/common/layout.h`` is written from them.

Every field is a 4-byte word or an array of them, so offsets agree everywhere; a record's size is a
multiple of 16 bytes.  ``tools/make_layout.py`` writes the header; a test asks the device.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from psf_cl.scene import primitives
from psf_cl.scene.model import LUMINANCE


@dataclass(frozen=True)
class Field:
    """One field: C name, scalar type, array extents, and what it means (with its unit)."""

    name: str
    type: str
    shape: tuple[int, ...]
    meaning: str


@dataclass(frozen=True)
class Record:
    """One struct."""

    name: str
    meaning: str
    fields: tuple[Field, ...]

    @cached_property
    def dtype(self) -> np.dtype:
        scalars = {"float": "<f4", "uint": "<u4", "int": "<i4"}
        return np.dtype([(item.name, scalars[item.type], item.shape) for item in self.fields])

    def c_text(self) -> str:
        lines = [f"/// {self.meaning}", "typedef struct {"]
        for item in self.fields:
            extents = "".join(f"[{extent}]" for extent in item.shape)
            lines.append(f"    {item.type} {item.name}{extents}; // {item.meaning}")
        return "\n".join([*lines, f"}} {self.name};"])


def _fields(text: str) -> tuple[Field, ...]:
    """Parse lines of ``type name[extents] - meaning``."""
    fields = []
    for line in text.strip().splitlines():
        declaration, meaning = line.strip().split(" - ", 1)
        kind, name = declaration.split()
        name, *extents = name.replace("]", "").split("[")
        fields.append(Field(name, kind, tuple(int(extent) for extent in extents), meaning))
    return tuple(fields)


def _filled(text: str) -> tuple[Field, ...]:
    """Parse as ``_fields``, and fill the record up to a multiple of 16 bytes."""
    fields = _fields(text)
    missing = -sum(math.prod(item.shape) for item in fields) % 4
    return fields + ((Field("pad", "uint", (missing,), "fills the record"),) if missing else ())


PARAMS = Record(
    "Params",
    "Everything that is the same for all paths of a render.",
    _filled("""
    float camera_origin[3] - world, m
    float lens_radius - m
    float camera_right[3] - unit, world
    float focus_distance - m
    float camera_up[3] - unit, world
    float film_scale_x - tangent of half the field of view; of parallel rays, m
    float camera_forward[3] - unit, world
    float film_scale_y - the same upwards
    uint width - pixels of the whole film
    uint height - pixels of the whole film
    uint pixel_count - pixels that are rendered
    uint crop_x - first column that is rendered
    uint crop_y - first row that is rendered
    uint crop_width - columns that are rendered
    uint crop_height - rows that are rendered
    uint ring - passes that may be in flight
    uint slots - paths of the pool
    uint seed - start of every random sequence
    uint max_depth - bounces
    uint splits - samples in a row whose paths begin alike
    uint split_vertex - where these part, 1 for the first surface seen
    uint roulette_depth - bounces before roulette
    uint light_count - entries of the light table
    uint environment_light - index of the environment in it
    uint node_bits - that a node of the tree of lights takes
    uint particle_cells - of the map of photons, a power of two
    float particle_cell - edge of a cell, m per m from the camera
    float virtual_clearance - radii of the scene; nearer virtual lights are no brighter
    uint shadow_rays - of each vertex; 0: as many as its photons ask for
    float photon_floor - chance that a light is drawn whatever photons say
    uint environment_width - texels
    uint environment_height - texels
    float environment_radiance[3] - constant sky, or factor of the image
    float environment_rotation[9] - world to local, row-major
    float scene_radius - m, of the bounding sphere
    float scene_center[3] - of it; world, m
    uint direct_sampling - DIRECT_MIS, DIRECT_LIGHT or DIRECT_BSDF
    uint sampler - SAMPLER_SOBOL or SAMPLER_RANDOM
    uint corner_count - of the list of corners, where all triangles are tested
    uint face_count - triangles between those corners
    uint plate_count - flat pieces that these make; 0: only corner by corner
    uint pair_count - plates, the first ones, that are parallelograms
    uint cell_min_count - samples below which a cell gives way to a wider one
    uint cell_slots - of the table of cells of one pass, a power of two
    uint cell_flags - CELL_JITTER, CELL_NEAR, CELL_IDENTITY
    float cell_width - edge of a cell in the first pass, m per m of the path
    uint cell_directions - parts of directions that cells of gloss tell apart, a side
    float cell_alpha - least GGX alpha of coats and metals that share at the first surface
    float cell_shrink - exponent of the number of the pass in the edge of a cell
    float cell_steps - fixed-point steps of a sum of radiance per unit, a power of two
    float cell_limit - radiance from which a sample is too large for the sums
    uint filter_vertex - first vertex whose light may be shared; FILTER_AUTO, FILTER_NONE
    uint filter_direct - whether light that falls on it directly is shared too
    float sky_limit - luminance up to which light of the sky is shared anyway; below 0: none
    float screen_radius - pixels; the screen filter's neighbours of a pixel's first sample
    uint screen_neighbours - of a pixel, that the screen filter asks
    uint temporal_rule - RULE_OFF, RULE_EXPONENTIAL, RULE_CUMULATIVE or RULE_ADAPTIVE
    float temporal_alpha - weight of a frame, by the exponential rule
    float cell_history - s, for which cells keep light that nobody sees
    float frame_time - s, of this frame
    uint history_flags - HISTORY_THERE, HISTORY_STILL, HISTORY_SAME_VIEW, HISTORY_CHANGED
    uint first_moving - the first triangle that moves: all after it do
    uint first_pass - of this frame; passes are counted on from frame to frame
    float previous_origin[3] - of the camera of the frame before; world, m
    float previous_right[3] - unit, world
    float previous_up[3] - unit, world
    float previous_forward[3] - unit, world
    float previous_scale_x - tangent of half the horizontal field of view
    float previous_scale_y - tangent of half the vertical field of view
    uint chain_start - independent paths of each chain, before the first state
    uint chain_pairs - pairs of random numbers that a chain keeps
    uint chain_numbers - words from those of a chain to those of the next
    float large_steps - chance of a path of new random numbers
    float splat_steps - fixed-point steps of a splat as bright as the mean, a power of two
    uint guide_slots - of the table of the guide, a power of two
    float guide_width - edge of its cells, m per m from the camera
    float guide_least - edge of the smallest of them, m
    float guide_most - edge of the largest, m
    float guide_share - of the directions of a diffuse lobe that the guide draws
    float guide_steps - fixed-point steps of a sum of its radiance per unit, a power of two
    float guide_limit - radiance from which a sample is too large for these sums
    uint cache_slots - of the table of the radiance cache, a power of two
    float cache_width - edge of its cells, m per m from the camera
    float cache_steps - fixed-point steps of a sum of radiance per unit, a power of two
    float cache_limit - radiance from which a sample is too large for these sums
    float cache_trace - least chance that a path goes on where a cell is known
    uint material_slots - of the table of the parameter cloud, a power of two
    float material_width - edge of its cells, m per m from the camera
    """),
)

BVH_NODE = Record(
    "BvhNode",
    "Eight children of an inner node; 256 bytes, so that a node fills whole cache lines.",
    _fields("""
    float bounds[6][8] - x low, x high, y low ... of each child; an empty one is inverted
    uint child[8] - node index, or LEAF_BIT | block index
    uint unused[8] - fills the cache line
    """),
)

TRIANGLE_BLOCK = Record(
    "TriangleBlock",
    "A leaf: up to four triangles side by side; an unused one is all NaN.",
    _fields("""
    float v[9][4] - vertex * 3 + axis; world, m
    uint id[4] - triangle index, ALPHA_BIT set if its alpha must be looked up
    """),
)

PLATE = Record(
    "Plate",
    "A flat piece of a small scene's list: two triangles that make a parallelogram, or one.",
    _fields("""
    float u[4] - of a point (p, 1): how far it is along the first edge, of 1
    float v[4] - the same along the second
    float n[4] - how far it is off the plane, m
    float slack - by which u and v may be wrong for each meter from the origin
    float slack_here - the same for the plate's own distance
    uint first - triangle where u + v < 1, with ALPHA_BIT; its corner at u = v = 0 << PLATE_TURN
    uint second - the other one; its corner at u = v = 1 << PLATE_TURN
    """),
)

BINARY_NODE = Record(
    "BinaryNode",
    "A node of the binary tree that the wide nodes are made from; one cache line.",
    _fields("""
    float low[3] - of its box; the scene's largest extent is 1
    uint left - child; of a leaf its triangle
    float high[3] - of its box
    uint right - child; of a leaf LEAF_BIT
    float costs[7] - least cost of the subtree as at most 1 .. 7 children of a wide node
    uint size - triangles below; LEAF_BIT set if they are best kept as one block
    """),
)

SURFACE = Record(
    "Surface",
    "A triangle as shading needs it; one cache line.",
    _fields("""
    float p0[3] - first vertex; world, m
    uint material - index into the materials
    float e1[3] - second vertex minus first
    uint light - index into the light table, NO_LIGHT if it does not emit
    float e2[3] - third vertex minus first
    float offset - m along ng that clears the rounding error of a point on it
    float ng[3] - unit normal of the front side
    uint shape - number of its shape among those that are visible
    """),
)

INSTANCE = Record(
    "Instance",
    "A placing of a mesh that has a tree of its own; two cache lines.",
    _fields("""
    float x_row[3] - of the matrix from the mesh to the world
    uint base - index of a hit minus that of its triangle
    float y_row[3] - second row
    uint root - node where the mesh's tree begins
    float z_row[3] - third row
    uint material - of all triangles, or OWN_MATERIAL
    float position[3] - of the mesh's origin; world, m
    float offset - m along ng that clears the rounding error of any point; 0: the triangles' own
    float inverse[9] - from the world to the mesh, without position, row by row
    float mirroring - -1 if the mesh is mirrored, else 1
    uint pad[2] - fills the record
    """),
)

REST_VERTEX = Record(
    "RestVertex",
    "A vertex that moves, in its own space.",
    _fields("""
    float p[3] - m
    uint first_delta - of its morph targets
    float n[3] - unit shading normal; zero if it is flat
    uint delta_count - morph targets
    float t[4] - tangent and sign; zero if it has none
    """),
)

MORPH_DELTA = Record(
    "MorphDelta",
    "What a morph target adds to a vertex, times its weight.",
    _fields("""
    float p[3] - m
    uint weight - index into the weights
    float n[3] - of the normal
    float pad0 - fills the word
    float t[3] - of the tangent
    float pad1 - fills the record
    """),
)

MOVED_VERTEX = Record(
    "MovedVertex",
    "A vertex where it is in this frame.",
    _fields("""
    float p[3] - world, m
    float side - -1 if it is mirrored, else 1
    float n[3] - unit shading normal; zero if it has none
    float pad - fills the word
    float t[4] - unit tangent and sign
    """),
)

CORNERS = Record(
    "Corners",
    "Where the corners of a triangle that moves were in the frame before.",
    _fields("""
    float p[9] - corner * 3 + axis; world, m
    float pad[3] - fills the record
    """),
)

NORMALS = Record(
    "Normals",
    "Shading normals of a triangle's corners; all zero if it is flat.",
    _fields("""
    float n0[3] - unit, world
    float pad0 - fills the word
    float n1[3] - unit, world
    float pad1 - fills the word
    float n2[3] - unit, world
    float pad2 - fills the word
    """),
)

UVS = Record(
    "Uvs",
    "Texture coordinates of a triangle's corners.",
    _fields("""
    float uv0[2] - first corner
    float uv1[2] - second corner
    float uv2[2] - third corner
    float density - area in coordinates over area, 1/m^2
    float pad - fills the record
    """),
)

VERTEX_COLORS = Record(
    "VertexColors",
    "Colours of a triangle's corners; they multiply the base colour.",
    _fields("""
    float c0[4] - linear Rec.709 and alpha
    float c1[4] - linear Rec.709 and alpha
    float c2[4] - linear Rec.709 and alpha
    """),
)

TANGENTS = Record(
    "Tangents",
    "Directions of growing u at a triangle's corners; all zero if it has none.",
    _fields("""
    float t0[4] - unit, world; then 1 or -1: the bitangent is that times normal x tangent
    float t1[4] - unit, world; the same
    float t2[4] - unit, world; the same
    """),
)

MATERIAL = Record(
    "Material",
    "Parameters of the one BSDF; textures are indices, NO_TEXTURE for none.",
    _fields("""
    float base_color[3] - linear Rec.709
    float metallic - 0 dielectric, 1 metal
    float emission[3] - radiance
    float roughness - its square is the alpha of GGX
    float f0 - dielectric reflectance at normal incidence, before the specular strength
    float specular - strength of the dielectric reflection; 0 for pure diffuse
    float ior - index of refraction
    float transmission - 0 opaque, 1 glass
    uint base_color_texture - colour and alpha
    uint emission_texture - colour
    uint metallic_roughness_texture - roughness in green, metallic in blue
    uint flags - MATERIAL_* bits
    float alpha - opacity, before textures
    float alpha_cutoff - least opacity that is there, of a mask
    uint normal_texture - tangent space
    float normal_scale - of its x and y
    float absorption[3] - per m, inside
    uint transmission_texture - red
    float specular_color[3] - linear Rec.709; tints the dielectric reflection
    uint specular_texture - alpha
    uint specular_color_texture - colour
    float clearcoat - strength of the coat
    float clearcoat_roughness - its square is the alpha of GGX
    uint clearcoat_texture - red
    float sheen_color[3] - linear Rec.709
    float sheen_roughness - its square is the alpha of the Charlie distribution
    uint clearcoat_roughness_texture - green
    uint sheen_color_texture - colour
    uint sheen_roughness_texture - alpha
    float anisotropy - 0 to 1
    float anisotropy_direction[2] - cosine and sine of the rotation from the tangent
    uint anisotropy_texture - direction in red and green, strength in blue
    float pad[5] - fills the cache line
    """),
)

TEXTURE = Record(
    "TextureInfo",
    "Where a texture's texels are, and how coordinates come to them.",
    _fields("""
    uint offset - first texel
    uint width - texels
    uint height - texels
    uint flags - TEXTURE_* bits: wrap of u and v, nearest, sRGB
    float matrix[6] - rows of the transform of (u, v, 1)
    uint uv_offset - to be added to a triangle's index, for its set of coordinates
    uint smaller - of its levels of half the size and less, the first; 0 for none
    """),
)

LIGHT = Record(
    "Light",
    "An emitter of the light table, with all that sampling it needs; two cache lines.",
    _fields("""
    uint kind - LIGHT_TRIANGLE, LIGHT_ENVIRONMENT, LIGHT_POINT, LIGHT_SPOT or LIGHT_DIRECTIONAL
    uint triangle - index, for LIGHT_TRIANGLE
    float pmf - chance to be picked
    float keep - alias table: chance that the slot keeps its own index
    float position[3] - world, m; of a triangle the first corner, of a sphere the center
    uint other - alias table: the index otherwise
    float direction[3] - unit, the way of its light; of a triangle the front's normal, of a sphere y
    float range - m, inf for none
    float intensity[3] - candela, lux, or a triangle's radiance
    float cos_outer - of the cone
    float e1[3] - of a triangle, second corner minus first; of a sphere its x axis, m
    float spot_scale - 1 / (cos inner - cos outer), floored
    float e2[3] - of a triangle, third corner minus first; of a sphere its z axis, m
    float area - m^2, of a triangle
    float offset - of a triangle, as Surface.offset
    uint emission_texture - index, NO_TEXTURE for none
    uint flags - of the material; LIGHT_RECTANGLE, with LIGHT_DISK or not, or LIGHT_SPHERE
    float power - candela along its brightest direction, or lux from infinitely far
    float pad[4] - fills the record
    """),
)

LIGHT_PAIR = Record(
    "LightPair",
    "Two sibling nodes of the tree of lights; one cache line.",
    _fields("""
    float center[2][3] - of a sphere around the lights; world, m
    float radius[2] - m; infinite: `power` is the weight wherever it is asked for
    float power[2] - of all its lights, as Light.power, in any one unit
    float cos_spread[2] - of the angle between the axis and any direction that a light faces
    uint axis[2] - mean direction that the lights face, octahedral, 16 bits a coordinate
    uint child[2] - index of a pair, or LEAF_BIT | a light, GROUP_BIT, CLUSTER_BIT; or NO_LIGHT
    """),
)

LIGHT_GROUP = Record(
    "LightGroup",
    "The subtree of lights around a light that photons do not tell apart.",
    _fields("""
    uint node - 2 * pair + side in the tree; NO_LIGHT for none
    float chance - that the table of lights draws one of its lights
    uint pad[2] - fills the record
    """),
)

VIRTUAL_LIGHT = Record(
    "VirtualLight",
    "Where a photon came to, as a light.",
    _fields("""
    float p[3] - world, m; off the surface
    uint ng - geometric normal, octahedral, 16 bits a coordinate
    float power[3] - radiant flux that its diffuse base reflects, times the photons drawn
    float pad - fills the record
    """),
)

LIGHT_BOUNDS = Record(
    "LightBounds",
    "What both nodes of a LightPair have in common, to fit their parent.",
    _fields("""
    float low[3] - world, m
    float power - as in LightPair
    float high[3] - world, m
    float spread - radians, as in LightPair
    float axis[3] - unit
    uint far - whether one of the lights is infinitely far
    """),
)

ENVIRONMENT_CELL = Record(
    "EnvironmentCell",
    "A texel of the environment: radiance and its slot of the alias table.",
    _fields("""
    float radiance[3] - before the factor
    float pmf - chance of the texel
    float keep - alias table
    uint other - alias table
    float pad[2] - fills the record
    """),
)

FILM_SUM = Record(
    "FilmSum",
    "All samples of one pixel of one plane.",
    _fields("""
    float sum[3] - of the values
    uint count - samples
    float lost[3] - what the sums lost by rounding
    float mean - running mean of the luminance
    float squares - sum of squared deviations from it
    float lost_squares - what that sum lost by rounding
    float pad[2] - fills the record
    """),
)

SEEN = Record(
    "Seen",
    "The first surface that a sample sees.",
    _fields("""
    float p[3] - world, m
    uint shape - 1 + its number, SHAPE_MOVES, SHAPE_SHINES; 0 if nothing is seen
    float ns[3] - unit, shading normal
    float gate[3] - throughput there, times the reflectance of the diffuse base
    float share[3] - part of what comes from beyond it, or its cell, that its base reflects
    float before[3] - where it was in the frame before
    """),
)

SEEN_MEAN = Record(
    "SeenMean",
    "The first surface that a pixel sees: means over its samples.",
    _fields("""
    float p[3] - world, m
    uint hits - samples that see a surface; p, ns and before are theirs
    float ns[3] - of the shading normals
    uint count - samples
    float gate[3] - of all samples: 0 where one sees nothing
    uint shape - of the first sample; SHAPE_SHINES of any
    float before[3] - where it was in the frame before
    float pad - fills the record
    """),
)

PIXEL_LIGHT = Record(
    "PixelLight",
    "Light of a pixel as the film and its history have it, before the screen filter.",
    _fields("""
    float rgb[3] - radiance
    float count - samples that it is worth
    float base[3] - of that, what the diffuse base of the first surface reflected
    float alpha - weight that this frame has in it
    float square - mean of the squared luminance of frames, or of the samples of one
    float change - of the light since the frame before, 0 to 1
    float noise - variance of the luminance of `base`, NOISE_UNKNOWN where nothing can be told
    float means - how many, samples or frames, `square` is of
    """),
)

HISTORY = Record(
    "History",
    "A pixel of the frame before: its light and what it sees.",
    _fields("""
    float rgb[3] - radiance
    float count - samples that it is worth; 0 if there is none
    float base[3] - of that, what the diffuse base of the first surface reflected
    uint shape - as SeenMean.shape
    float p[3] - world, m
    float square - mean of the squared luminance of frames
    float ns[3] - unit, shading normal
    float pad - fills the record
    """),
)

PROBE = Record(
    "Probe",
    "A path from a surface that is traced again in the next frame.",
    _fields("""
    uint triangle - of its vertex; NO_HIT if there is none
    float u - barycentric coordinate there
    float v - barycentric coordinate there
    uint seed - of the points on its lights
    float direction[3] - unit, in which it goes on
    uint light - of its vertex
    float wo[3] - unit, from where it was seen
    uint next_light - of the surface that it goes on to
    float pmf - chance that the light had
    float next_pmf - the same of the next
    float reflected[2] - luminance that its surfaces reflected in the frame before, and in this one
    float emitted[2] - luminance that its vertex gave away itself, in both
    float pad[2] - fills the record
    """),
)

CELL_VERTEX = Record(
    "CellVertex",
    "The vertex of a sample behind which light is shared.",
    _fields("""
    float p[3] - world, m
    uint ng - geometric normal, octahedral, 16 bits a coordinate
    float gate[3] - throughput from the camera, times the reflectance that was taken out
    float length - m, of the path up to here
    """),
)

BEYOND = Record(
    "Beyond",
    "What a sample gathered behind its cell's vertex.",
    _fields("""
    float radiance[3] - at the camera
    uint vertex - 1 + its depth, VERTEX_NEAR, VERTEX_REJECTED, a face, a wall; 0 if there is none
    """),
)

LOST = Record(
    "Lost",
    "What averages per cell took from a pixel: sums over its samples, or a mean and its variance.",
    _fields("""
    float rgb[3] - its own radiance minus that of the averages
    float difference - of its luminance between two halves of the samples; of a mean its variance
    """),
)

CELL = Record(
    "Cell",
    "What a cell gathers: 64-bit fixed-point sums.",
    _fields("""
    uint low[3] - of radiance; from resolve_cells on the bits of their mean, a float
    uint count - samples
    uint high[3] - of radiance
    uint change - of the light since the frame before, the bits of a float
    """),
)

CELL_HISTORY = Record(
    "CellHistory",
    "What a cell knows from the frames before, and what it gathers in this one.",
    _fields("""
    float mean[3] - radiance behind the vertices in it
    float count - samples that it is worth; 0 if there was no frame before
    float sum[3] - of the samples of this frame
    float fresh - these samples
    float square - mean of the squared luminance of frames
    float frames - frames that it is worth
    float seen - s, time of the last frame with samples in it
    float change - of the light since the frame before, 0 to 1
    """),
)

SHARED_LIGHT = Record(
    "SharedLight",
    "What the samples of a pixel took from cells: sums over them.",
    _fields("""
    float fresh[3] - radiance, by the averages of this frame
    float frames - that what was known of these cells is worth
    float known[3] - radiance, by what was known of them
    float samples - that found a cell
    float base[3] - of that, what the diffuse base of the first surface reflected
    float unused - fills the record
    """),
)

SHARED_PIXEL = Record(
    "SharedPixel",
    "A pixel's own part of what it shows of cells, and what they add from before it was seen.",
    _fields("""
    float mean[3] - radiance from cells, over the frames that the pixel knows
    float count - samples that the pixel is worth by itself
    float older[3] - the same by what cells knew before each of these frames
    float pad - fills the record
    float added[3] - radiance
    float spare - fills the record
    float base[3] - of that, what the diffuse base of the first surface reflected
    float unused - fills the record
    """),
)

CELL_SQUARES = Record(
    "CellSquares",
    "The second moment of a cell: a 64-bit fixed-point sum.",
    _fields("""
    uint low - of (luminance / cell_limit)^2; from resolve_cells on a float's bits: the variance
    uint high - of the same
    uint unused[2] - fills 16 bytes
    """),
)

CELL_VIEW = Record(
    "CellView",
    "What the samples of a pixel saw of cells: sums over its samples.",
    _fields("""
    float color[3] - of the cell of the first pass, made of its key; not a sum
    float occupancy - part of its bucket's slots that are taken
    float count - samples in it
    float variance - of their luminance
    float weight - 1 for a sample that used a cell's average
    float pad - fills the record
    """),
)

SPLAT_SUM = Record(
    "SplatSum",
    "What the paths of a pass brought to a pixel: 64-bit fixed-point sums.",
    _fields("""
    uint low[3] - of radiance
    uint high[3] - of radiance
    uint pad[2] - fills the record
    """),
)

CACHE_SUM = Record(
    "CacheSum",
    "What a cell of the radiance cache gathers: 64-bit fixed-point sums.",
    _fields("""
    uint low[4] - of rgb over the reflectance; of the squared luminance over the mean
    uint high[4] - of the same
    uint count - visits
    uint near - of these, by paths that came from nearer than its edge
    uint pad[2] - fills the record
    """),
)

CACHE_CELL = Record(
    "CacheCell",
    "What a cell of the radiance cache knows, the same for a whole epoch.",
    _fields("""
    float mean[3] - radiance that a white diffuse surface reflects there
    float ends - chance that a path ends there
    float visits - that it is made from; 0: nothing is known
    float pad[3] - fills the record
    """),
)

MATERIAL_SUM = Record(
    "MaterialSum",
    "What a cell of the parameter cloud gathers: 64-bit fixed-point sums.",
    _fields("""
    uint low[5] - of what textures gave: rgb of the base colour, roughness, metallic
    uint high[5] - of the same
    uint count - vertices that looked it up
    uint pad - fills the record
    """),
)

MATERIAL_CELL = Record(
    "MaterialCell",
    "What a cell of the parameter cloud knows, the same for a whole epoch.",
    _fields("""
    float color[3] - factor of the base colour that textures give
    float roughness - of the roughness
    float metallic - of the metallic part
    uint visits - that it is made from; 0: nothing is known
    uint pad[2] - fills the record
    """),
)

#: Parts of the hemisphere that the guide tells apart, a side of the square.
GUIDE_SIDE = 8

GUIDE_SUM = Record(
    "GuideSum",
    "What a cell of the guide gathers: 64-bit fixed-point sums of each part of the hemisphere.",
    _fields(f"""
    uint low[{GUIDE_SIDE**2}] - of radiance
    uint high[{GUIDE_SIDE**2}] - of radiance
    uint count[{GUIDE_SIDE**2}] - visits
    """),
)

GUIDE_CELL = Record(
    "GuideCell",
    "What paths are drawn by at a cell of the guide, the same for a whole epoch.",
    _fields(f"""
    float density[{GUIDE_SIDE**2}] - of each part, over that of the cosine, row by row
    float rows[{GUIDE_SIDE}] - share of all rows up to this
    float mean - over the parts: what a white diffuse surface reflects of what no shadow ray finds
    float visits - that it is made from; 0: nothing is known
    float pad[6] - fills the record
    """),
)

GUIDE_VIEW = Record(
    "GuideView",
    "What the guide knows at what a pixel sees.",
    _fields("""
    float direction[3] - mean of those that it draws, world; 0 where nothing is known
    float entropy - of the parts of the hemisphere that they are in, bits
    float visits - that its cells are made from
    float pad[3] - fills the record
    """),
)

RECORDS = (
    PARAMS,
    BVH_NODE,
    TRIANGLE_BLOCK,
    PLATE,
    BINARY_NODE,
    SURFACE,
    INSTANCE,
    REST_VERTEX,
    MORPH_DELTA,
    MOVED_VERTEX,
    CORNERS,
    NORMALS,
    UVS,
    VERTEX_COLORS,
    TANGENTS,
    MATERIAL,
    TEXTURE,
    LIGHT,
    LIGHT_PAIR,
    LIGHT_GROUP,
    VIRTUAL_LIGHT,
    LIGHT_BOUNDS,
    ENVIRONMENT_CELL,
    FILM_SUM,
    SEEN,
    SEEN_MEAN,
    PIXEL_LIGHT,
    HISTORY,
    PROBE,
    CELL_VERTEX,
    BEYOND,
    LOST,
    CELL,
    CELL_HISTORY,
    SHARED_LIGHT,
    SHARED_PIXEL,
    CELL_SQUARES,
    CELL_VIEW,
    SPLAT_SUM,
    CACHE_SUM,
    CACHE_CELL,
    MATERIAL_SUM,
    MATERIAL_CELL,
    GUIDE_SUM,
    GUIDE_CELL,
    GUIDE_VIEW,
)

#: Words of every path's state, in the order in which they lie in a block of the pool.
PATH_FIELDS = (
    ("origin_x", "ray origin, world, m"),
    ("origin_y", ""),
    ("origin_z", ""),
    ("direction_x", "unit ray direction"),
    ("direction_y", ""),
    ("direction_z", ""),
    ("hit_triangle", "uint; NO_HIT if the ray left the scene"),
    ("hit_t", "m"),
    ("hit_u", "barycentric coordinate of the second corner"),
    ("hit_v", "barycentric coordinate of the third corner"),
    ("beta_r", "throughput"),
    ("beta_g", ""),
    ("beta_b", ""),
    ("radiance_r", "gathered so far"),
    ("radiance_g", ""),
    ("radiance_b", ""),
    ("direct_r", "of that, what light reflected at most once brought"),
    ("direct_g", ""),
    ("direct_b", ""),
    ("pdf", "solid-angle density of the direction; PDF_DELTA if lights are not sampled for it"),
    ("status", "uint; STATUS_* bits and the depth"),
    ("sample", "uint; index of the sample, which is its pass"),
    ("pixel", "uint; position in the order of pixels"),
    ("seed", "uint; of the pixel, by its place on the film"),
    ("shadow_x", "shadow ray origin, world, m"),
    ("shadow_y", ""),
    ("shadow_z", ""),
    ("toward_x", "from there to the light, not normalised: the light is at t = 1"),
    ("toward_y", ""),
    ("toward_z", ""),
    ("light_r", "radiance that arrives if nothing is in between, times beta; all 0: no ray"),
    ("light_g", ""),
    ("light_b", ""),
)

#: Most shadow rays of a vertex.
MOST_SHADOW_RAYS = 8

#: Words of each shadow ray of a vertex after the first: what the first has, in this order, also if
#: the features are off that ask for it.
RAY_FIELDS = tuple(
    f"{name}_{axis}" if axis else name
    for name, axes in (
        ("shadow", "xyz"),
        ("toward", "xyz"),
        ("light", "rgb"),
        ("light_share", "rgb"),
        ("base_light", "rgb"),
        ("cache_light", "rgb"),
        ("guide_light", " "),
    )
    for axis in axes.strip() or [""]
)

#: Words that only paths of some features have: (feature, least value of it, words).
OPTIONAL_PATH_FIELDS = (
    (
        "TRANSMISSION",
        1,
        (
            (
                "denser",
                "by what glass around it makes beta smaller: its indices squared, multiplied",
            ),
        ),
    ),
    (
        "LIGHT_SAMPLING",
        1,
        (("light_normal", "uint; packed: what the last light was chosen for, besides the origin"),),
    ),
    (
        "LIGHT_SAMPLING",
        2,
        (("particle_row", "uint; row of the table of photons that it was chosen by"),),
    ),
    *(
        (
            "SHADOW_RAYS",
            ray,
            tuple((f"ray{ray}_{name}", f"of shadow ray {ray}") for name in RAY_FIELDS),
        )
        for ray in range(2, MOST_SHADOW_RAYS + 1)
    ),
    (
        "BASE",
        1,
        (
            ("base_r", "of what goes to the pixel, what the base of the first surface reflected"),
            ("base_g", ""),
            ("base_b", ""),
        ),
    ),
    (
        "BASE",
        2,
        (
            ("base_share_r", "part of what comes from beyond that surface that its base reflects"),
            ("base_share_g", ""),
            ("base_share_b", ""),
            ("base_light_r", "the same of the shadow ray"),
            ("base_light_g", ""),
            ("base_light_b", ""),
        ),
    ),
    (
        "CELLS",
        1,
        (
            (
                "vertex",
                "uint; 1 + depth of the vertex behind which light is shared, its face; 0: none",
            ),
            ("length", "m, from the camera on"),
            ("beyond_r", "of what was gathered, what is shared: it came from beyond that vertex"),
            ("beyond_g", ""),
            ("beyond_b", ""),
        ),
    ),
    (
        "CELLS",
        2,
        (
            ("share_r", "part of what comes from beyond the vertex that is shared"),
            ("share_g", ""),
            ("share_b", ""),
            ("light_share_r", "the same of the shadow ray"),
            ("light_share_g", ""),
            ("light_share_b", ""),
        ),
    ),
    (
        "CACHE",
        1,
        (
            ("cache", "uint; cell that the path learns for; NO_SLOT: none"),
            ("cache_gate_r", "part of light from here that it reflects, over its reflectance"),
            ("cache_gate_g", ""),
            ("cache_gate_b", ""),
            ("cache_light_r", "what arrives through the shadow ray, by the same measure"),
            ("cache_light_g", ""),
            ("cache_light_b", ""),
        ),
    ),
    (
        "GUIDE",
        1,
        (
            ("guide", "uint; part of the guide's cell that the ray left through; NO_PART: none"),
            ("guide_from", "uint; that of the ray before the shadow ray"),
            ("expected", "luminance at the camera that the first vertex was expected to reflect"),
            ("guide_light", "luminance that arrives through the shadow ray, reflected along that"),
        ),
    ),
)

#: Words of every chain, in the order in which they lie in a block of chains.
CHAIN_FIELDS = (
    ("known", "uint; pairs of numbers of the state from which the path starts; 0: a large step"),
    ("pairs", "uint; pairs of numbers that the state has"),
    ("paths", "uint; paths that have come to their end"),
    ("pass", "uint; the pass that the next path counts to"),
    ("place", "uint; its place in it"),
    ("radiance_r", "of the state"),
    ("radiance_g", ""),
    ("radiance_b", ""),
    ("pixel", "uint; of the state, position in the order of pixels"),
    ("independent", "luminance of the paths after large steps, summed"),
    ("lost", "what that sum lost by rounding"),
    ("large", "uint; large steps"),
    ("large_accepted", "uint"),
    ("small", "uint; small steps"),
    ("small_accepted", "uint"),
)

#: Words of the counters of photons, all uint: what became of those that were emitted.
PHOTON_COUNTERS = (
    ("emitted", "with any power, also one that is not finite"),
    ("dark", "drawn where their light gives none"),
    ("escaped", "left the scene"),
    ("stored", "deposits in the map"),
    ("absorbed", "ended at a surface that reflected no more; of those that go on"),
    ("cut", "ended by the limit of bounces; of those that go on"),
    ("rejected", "ended with a power that is not finite"),
)

#: Words of the counters, all uint.
COUNTERS = (
    ("next_pixel", "next pixel to be started, counted from the first pixel of next_pass"),
    ("next_pass", "pass that next_pixel 0 belongs to"),
    ("film_pass", "passes that the film holds"),
    ("pass_limit", "first pass that must not be started; set by the host"),
    ("camera_rays", "low word"),
    ("camera_rays_high", "high word"),
    ("bounce_rays", "low word"),
    ("bounce_rays_high", "high word"),
    ("shadow_rays", "low word"),
    ("shadow_rays_high", "high word"),
    ("rejected_samples", "samples that were not finite, or too large to be summed"),
    ("failed_inserts", "low word; samples that found their part of the table of cells full"),
    ("failed_inserts_high", "high word"),
    ("rejected_cells", "low word; samples too large for the sums of a cell"),
    ("rejected_cells_high", "high word"),
    ("failed_histories", "low word; cells of passes that the cells' history had no room for"),
    ("failed_histories_high", "high word"),
    ("unfiltered_samples", "low word; samples that looked for a cell and found none"),
    ("unfiltered_samples_high", "high word"),
    ("cells_used", "low word; cells with samples, summed over passes"),
    ("cells_used_high", "high word"),
    ("cell_probes", "low word; slots looked at to find each of these once"),
    ("cell_probes_high", "high word"),
    ("chain_limit", "first path of a chain that must not be started; set by the host"),
    ("chain_starts", "paths of chains that ended before the first pass"),
    ("dark_samples", "low word; samples that gathered no light"),
    ("dark_samples_high", "high word"),
    ("guide_failed", "vertices that found their part of the table of the guide full"),
    ("guide_rejected", "what is not finite, or too large for the sums of the guide"),
    ("guide_off", "1 if the guide does not pay here, and is left out; set by the host"),
    ("learn_limit", "first pass that the guide learns nothing from; set by the host"),
    ("cache_failed", "vertices that found their part of the table of the radiance cache full"),
    ("cache_rejected", "what is not finite, or too large for the sums of the radiance cache"),
    ("cache_ends", "low word; paths that ended by the radiance cache"),
    ("cache_ends_high", "high word"),
    ("material_failed", "vertices that found their part of the parameter cloud full"),
    ("pending_camera", "rays since the last film launch"),
    ("pending_bounce", ""),
    ("pending_shadow", ""),
    ("finished", "first of the ring: samples done of each pass in flight"),
)

#: What the rounding error of a point is bounded by, relative to the coordinates it is made of: the
#: intersection subtracts, shears and divides, about eight roundings of 2^-24.
OFFSET_EPSILON = 2.0**-20

FLOAT_CONSTANTS = (
    ("OFFSET_EPSILON", OFFSET_EPSILON, "rounding error of a point, relative to its coordinates"),
    ("LUMINANCE_RED", LUMINANCE[0], ""),
    ("LUMINANCE_GREEN", LUMINANCE[1], ""),
    ("LUMINANCE_BLUE", LUMINANCE[2], ""),
    ("TEXEL_STEPS", 2.0**24, "fixed-point steps of sums of texels, which are from 0 to 1"),
    ("SAME_SURFACE_COSINE", 0.9, "normals further apart are those of different surfaces"),
    ("NOISE_UNKNOWN", 1e30, "variance of light of which too little is known to tell it"),
)
CONSTANTS = (
    ("LEAF_BIT", 0x80000000, "child[] is a block of triangles"),
    ("GROUP_BIT", 0x40000000, "child[] of a LightPair is a group of lights for photons"),
    ("CLUSTER_BIT", 0x20000000, "child[] of a LightPair is a cluster of lights"),
    ("NODE_MASK", 0x1FFFFFFF, "what child[] of a LightPair says beside these and LEAF_BIT"),
    ("CLUSTER_LIGHT", 0, "of light_clusters, by slot: the light that it keeps"),
    ("CLUSTER_KEEP", 1, "by slot: chance that it keeps it, float"),
    ("CLUSTER_OTHER", 2, "by slot: the light otherwise"),
    ("CLUSTER_CHANCE", 3, "by light: that its cluster draws it, float"),
    ("CLUSTER_PLACE", 4, "by light: 2 * pair + side of its cluster; NO_LIGHT for none"),
    ("CLUSTER_FIRST", 5, "by pair that is a cluster: its first slot"),
    ("CLUSTER_LENGTH", 6, "by pair: how many slots it has; 0 for none"),
    ("CLUSTER_PARTS", 7, "each as long as there are lights"),
    ("ALPHA_BIT", 0x80000000, "id[] needs its alpha looked up"),
    ("PLATE_TURN", 28, "bit of the number of a corner"),
    ("NO_HIT", 0xFFFFFFFF, ""),
    ("NO_LIGHT", 0xFFFFFFFF, ""),
    ("NO_VERTEX", 0xFFFFFFFF, "it does not move"),
    ("NO_TEXTURE", 0xFFFFFFFF, ""),
    ("OWN_MATERIAL", 0xFFFFFFFF, "each triangle has its own"),
    ("MATERIAL_TWO_SIDED_EMISSION", 1, ""),
    ("MATERIAL_ALPHA_MASK", 2, "hits must look up the alpha"),
    ("MATERIAL_ALPHA_BLEND", 4, "with a chance of alpha a hit is there"),
    ("MATERIAL_UNLIT", 8, "what it emits is its base colour; it is no light"),
    ("MATERIAL_THIN", 16, "a sheet of glass: light goes through unbent"),
    ("MATERIAL_HIDES_BACK", 32, "the camera looks through what it would see from behind"),
    ("TEXTURE_CLAMP_U", 1, ""),
    ("TEXTURE_MIRROR_U", 2, ""),
    ("TEXTURE_CLAMP_V", 4, ""),
    ("TEXTURE_MIRROR_V", 8, ""),
    ("TEXTURE_NEAREST", 16, ""),
    ("TEXTURE_SRGB", 32, ""),
    ("LIGHT_RECTANGLE", 256, "the light is two triangles: e1 and e2 are edges of a rectangle"),
    ("LIGHT_SPHERE", 512, "the light is a sphere: many triangles"),
    ("LIGHT_DISK", 1024, "of the rectangle only the disk in it gives light"),
    ("LIGHT_TRIANGLE", 0, ""),
    ("LIGHT_ENVIRONMENT", 1, ""),
    ("LIGHT_POINT", 2, ""),
    ("LIGHT_SPOT", 3, ""),
    ("LIGHT_DIRECTIONAL", 4, ""),
    ("DIRECT_MIS", 0, ""),
    ("DIRECT_LIGHT", 1, ""),
    ("DIRECT_BSDF", 2, ""),
    ("SAMPLER_SOBOL", 0, ""),
    ("SAMPLER_RANDOM", 1, ""),
    ("PAIR_VERTEX", 2, "first pair of random numbers of the first vertex"),
    ("VERTEX_PAIRS", 4, "pairs of each vertex"),
    ("DISK_SEGMENTS", primitives.DISK_SEGMENTS, "corners of a light that is a disk"),
    ("SPHERE_COLUMNS", primitives.SPHERE_COLUMNS, "of faces of a light that is a sphere"),
    ("SPHERE_ROWS", primitives.SPHERE_ROWS, ""),
    ("STRIP_ROWS", 4, "rows of pixels that the queue takes column by column"),
    ("RESTORE_TILE", 16, "edge of the tiles whose noise filter_restore compares, pixels"),
    ("STATUS_IDLE", 0, "the slot has no path yet"),
    ("STATUS_WAITING", 0x40000000, "it holds a sample whose pass may not start yet"),
    ("STATUS_ALIVE", 0x80000000, "it traces a ray"),
    ("STATUS_DONE", 0xC0000000, "the path ended, the film does not have it yet"),
    ("STATUS_MASK", 0xC0000000, ""),
    ("DEPTH_MASK", 0x3FFFFFFF, "bounces so far"),
    ("FILTER_AUTO", 0, "the first vertex that a wide lobe reached, over more than a cell"),
    ("FILTER_NONE", 0xFFFFFFFF, "no vertex"),
    ("VERTEX_NEAR", 0x80000000, "set if the path met a surface within a cell of its vertex"),
    ("VERTEX_FACE_SHIFT", 27, "first bit of the side that a surface near the vertex faces"),
    ("VERTEX_FACE_MASK", 7, "of that, shifted: axis and sign, 0 to 5"),
    ("VERTEX_REJECTED", 0x40000000, "set if what was gathered is too large for a cell"),
    ("VERTEX_WALL_SHIFT", 24, "first bit of what separates the vertex from where it is stored"),
    ("VERTEX_WALL_MASK", 7, "of that, shifted: 0 nothing, or 1 + the side that a wall faces"),
    ("VERTEX_GLOSSY", 0x200000, "set if coats and metals share what they reflect there"),
    (
        "VERTEX_SKY",
        0x400000,
        "set if its shadow ray goes where the sky is even: that light is shared",
    ),
    ("VERTEX_MASK", 0x1FFFFF, "1 + depth"),
    ("CELL_JITTER", 1, "points are moved before they are told apart by cells"),
    ("CELL_NEAR", 4, "samples of light from near have cells of their own"),
    ("CELL_IDENTITY", 2, "every sample has a cell of its own: nothing is shared (tests)"),
    ("SHAPE_MOVES", 0x80000000, "its triangles move between frames"),
    ("SHAPE_SHINES", 0x40000000, "it glows where it is seen"),
    ("RULE_OFF", 0, "frames know nothing of one another"),
    ("RULE_EXPONENTIAL", 1, "a frame has a constant weight"),
    ("RULE_CUMULATIVE", 2, "all samples since it was first seen have the same weight"),
    ("RULE_ADAPTIVE", 3, "the same where nothing changes, more for new ones where something does"),
    ("PROBE_TILE", 4, "edge of the tiles that have a probe each, pixels"),
    ("HISTORY_THERE", 1, "there is a frame before"),
    ("HISTORY_STILL", 2, "neither camera nor geometry has moved since"),
    ("HISTORY_SAME_VIEW", 4, "the camera has not moved since"),
    ("HISTORY_CHANGED", 8, "probes have looked for changes of light since"),
    ("GUIDE_SIDE", GUIDE_SIDE, "parts of the hemisphere a side of the square"),
    ("GUIDE_BINS", GUIDE_SIDE**2, ""),
    ("RAY_WORDS", len(RAY_FIELDS), "of a path, for each shadow ray after the first"),
    ("VIRTUAL_LIGHTS_MOST", 1 << 13, "slots of the table of virtual lights"),
    ("VIRTUAL_SHIFT", 32 - 13, "of random numbers, down to its slots"),
    ("PARTICLE_PLACES", 64, "of a cell of the map of photons"),
    ("PARTICLE_KINDS", 14, "groups of lights that a cell of it knows at most"),
    ("PARTICLE_SIZES", 3, "of cells of that map, each four times as wide as the one before"),
    ("BUCKET_SLOTS", 64, "slots of a hash map that are probed for a key"),
)

_FRAME = """\
// Written by tools/make_layout.py from psf_cl/device/layout.py: change that, then run it.
#pragma once

{constants}

{paths}

{chains}

{counters}

{photon_counters}

{records}
"""


def _define(name: str, value: str, meaning: str = "") -> str:
    return f"#define {name} {value}" + (f" // {meaning}" if meaning else "")


def _path_lines() -> list[str]:
    """Return the places of the fields of a path; those of features follow one another."""
    lines = [
        _define(f"PATH_{name.upper()}", f"{index}u", meaning)
        for index, (name, meaning) in enumerate(PATH_FIELDS)
    ]
    end = f"{len(PATH_FIELDS)}u"
    for number, (feature, least, fields) in enumerate(OPTIONAL_PATH_FIELDS, start=1):
        lines.append(f"#if {feature} >= {least}")
        lines += [
            _define(f"PATH_{name.upper()}", f"({end} + {index}u)", meaning)
            for index, (name, meaning) in enumerate(fields)
        ]
        lines.append(_define(f"PATH_END_{number}", f"({end} + {len(fields)}u)"))
        lines.append("#else")
        lines.append(_define(f"PATH_END_{number}", end))
        lines.append("#endif")
        end = f"PATH_END_{number}"
    return [*lines, _define("PATH_FIELD_COUNT", end)]


def _chain_lines() -> list[str]:
    lines = [
        _define(f"CHAIN_{name.upper()}", f"{index}u", meaning)
        for index, (name, meaning) in enumerate(CHAIN_FIELDS)
    ]
    return [*lines, _define("CHAIN_FIELD_COUNT", f"{len(CHAIN_FIELDS)}u")]


def path_field_count(values: Mapping[str, int]) -> int:
    """Return the words of a path's state under the ``values`` of the features."""
    return len(PATH_FIELDS) + sum(
        len(fields)
        for feature, least, fields in OPTIONAL_PATH_FIELDS
        if values.get(feature, 0) >= least
    )


def header() -> str:
    """Return the text of ``cl/common/layout.h``."""

    def define(name: str, value: int, meaning: str) -> str:
        return _define(name, f"0x{value:08X}u" if value > 0xFFFF else f"{value}u", meaning)

    return _FRAME.format(
        constants="\n".join(
            [define(*constant) for constant in CONSTANTS]
            + [_define(name, f"{value}f", meaning) for name, value, meaning in FLOAT_CONSTANTS]
        ),
        paths="\n".join(_path_lines()),
        chains="\n".join(_chain_lines()),
        counters="\n".join(
            define(f"COUNTER_{name.upper()}", index, meaning)
            for index, (name, meaning) in enumerate(COUNTERS)
        ),
        photon_counters="\n".join(
            define(f"PHOTONS_{name.upper()}", index, meaning)
            for index, (name, meaning) in enumerate(PHOTON_COUNTERS)
        ),
        records="\n\n".join(record.c_text() for record in RECORDS),
    )


COUNTER_INDEX = {name: index for index, (name, _) in enumerate(COUNTERS)}
CHAIN_INDEX = {name: index for index, (name, _) in enumerate(CHAIN_FIELDS)}

#: What rays are traced for.
RAY_KINDS = ("camera", "bounce", "shadow")

CONSTANT = {name: value for name, value, _ in CONSTANTS}


def all_path_fields() -> tuple[str, ...]:
    """Return the fields of the path's state, those of features too."""
    optional = (name for _, _, fields in OPTIONAL_PATH_FIELDS for name, _ in fields)
    return (*(name for name, _ in PATH_FIELDS), *optional)


def path_fields(*names: str) -> tuple[str, ...]:
    """Return the fields of the path's state that ``names`` tell of: fields, or stems of vectors.

    Raises:
        ValueError: there is no such field.
    """
    found = []
    every = all_path_fields()
    for name in names:
        matching = [name] if name in every else []
        matching = matching or [known for known in every if known.rpartition("_")[0] == name]
        if not matching:
            raise ValueError(f"{name}: no such field of a path")
        found += matching
    return tuple(found)


def whole(counters: np.ndarray, name: str) -> int:
    """Return a counter of two words."""
    at = COUNTER_INDEX[name]
    return int(counters[at]) + (int(counters[at + 1]) << 32)


def rays_so_far(counters: np.ndarray, kind: str) -> int:
    """Return the rays of ``kind`` (one of ``RAY_KINDS``) that ``counters`` tell of."""
    # Those since the last film launch have not been carried over into the two words yet.
    pending = int(counters[COUNTER_INDEX[f"pending_{kind}"]])
    return whole(counters, f"{kind}_rays") + pending
