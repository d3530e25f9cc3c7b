"""What scene, settings and AOVs need, by feature, each with the reason that the plan gives."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from psf_cl.errors import InputError
from psf_cl.few import list_of
from psf_cl.image import AOVS
from psf_cl.instancing import Levels
from psf_cl.motion import corner_labels, count_moving, lights_change
from psf_cl.scene.model import (
    TEXTURE_FIELDS,
    Material,
    Scene,
    emits,
    has_environment,
    has_layers,
    has_tangents,
    hides_back,
    is_cut_out,
    lets_through,
    shines,
)
from psf_cl.settings import Settings
from psf_cl.stages import cells, guide, photons
from psf_cl.stages.spec import Feature
from psf_cl.tables import (
    count_whole_lights,
    flatten,
    leveled_textures,
    light_spread,
    visible_shapes,
)
from psf_cl.traits import DeviceTraits

#: Lights (emitting triangles are one each) from which on ``light_sampling=auto`` asks photons.
#: At equal times, against a table: with 12,050 (``many_lights``) a quarter of the error; with 1,201
#: (a map of a game, 64 x 40) 1.7 times as much at 16 spp; other scenes here have at most 12.
MANY_LIGHTS = 4096

#: ``light_spread`` from which on they are many lights, not one that is made of many triangles: of
#: such a lamp all triangles are near or far together, and a table is as good for less.
SPREAD_LIGHTS = 0.5


def instances_feature(levels: Levels | None, shown: int) -> Feature:
    """Return whether meshes have trees of their own, with the bits of an index in them."""
    if levels is None:
        return Feature(0, "few triangles would be saved by placing meshes more than once")
    places = f"{levels.place_count} places of {len(levels.parts)} meshes"
    kept = f"{levels.triangle_count} triangles in place of {shown}"
    return Feature(levels.index_bits, f"{places}: {kept}")


def few_pieces(scene: Scene, triangles: int, traits: DeviceTraits) -> tuple[int, int]:
    """Return the distinct corners and the plates of a small scene, 0 of one too large to ask."""
    if triangles > traits.few_triangles:
        return 0, 0
    geometry = flatten(scene, densities=False)
    few, plates = list_of(geometry, scene.materials, corner_labels(scene))
    return len(few.corners), len(plates.records)


def few_feature(triangles: int, corners: int, plates: int, traits: DeviceTraits) -> Feature:
    """Return whether all triangles are tested, with the room for their corners."""
    if triangles > traits.few_triangles:
        return Feature(0, f"a tree: {triangles} triangles")
    if corners > traits.few_corners:
        return Feature(0, f"a tree: {corners} corners")
    if plates > traits.few_plates:
        return Feature(0, f"a tree: {triangles} triangles, {plates} plates")
    # In steps, so that scenes of about the same size share their programs.
    room = max(32 * -(-corners // 32), 32)
    return Feature(room, f"no tree: {triangles} triangles, {plates} plates, {corners} corners")


def find_features(
    scene: Scene, settings: Settings, outputs: frozenset[str]
) -> tuple[dict[str, Feature], frozenset[str]]:
    """Return what scene, settings and AOVs need, by macro, and the AOVs that there can be.

    All but what depends on the number of triangles: ``few_feature``, ``instances_feature``.

    Raises:
        InputError: an AOV shows what there is not.
    """
    features = _features(scene, settings, outputs)
    outputs = _without_light_aovs(outputs, features)
    features["AOV_LIGHTS"] = _aov_lights(outputs, features["LIGHT_SAMPLING"])
    features["TEMPORAL"] = _temporal(scene, settings, features)
    features["CELL_HISTORY"] = _cell_history(settings, features)
    return features, outputs


def _features(scene: Scene, settings: Settings, outputs: frozenset[str]) -> dict[str, Feature]:
    shapes = visible_shapes(scene)
    materials = [scene.materials[i] for i in sorted({shape.material for shape in shapes})]
    lights = [light for light in scene.lights if shines(light)]
    sky = has_environment(scene.environment)
    image = scene.environment.image is not None

    def switch(value: bool, yes: str, no: str) -> Feature:
        return Feature(int(value), yes if value else no)

    textured = any(getattr(m, name) >= 0 for m in materials for name in TEXTURE_FIELDS)
    cut_out = any(is_cut_out(scene.materials[shape.material], shape.mesh) for shape in shapes)
    blended = cut_out and any(m.alpha_mode == "blend" for m in materials)
    glows = any(emits(m) or m.unlit for m in materials)
    glossy = any(
        (m.metallic > 0.0 or m.specular > 0.0 or m.transmission > 0.0 or has_layers(m))
        and not m.unlit
        for m in materials
    )
    connected = _connect(settings, any(emits(m) for m in materials) or sky, bool(lights))
    rectangles = _rectangles(scene, settings, bool(connected.value))
    spheres = _spheres(scene, settings, bool(connected.value))
    kinds = whole_kinds({"RECTANGLES": rectangles, "SPHERES": spheres})
    chosen = _light_sampling(settings, bool(connected.value), light_count(scene, kinds), scene)
    feature_aovs = outputs & {"albedo", "normal", "depth"}
    return {
        "TEXTURES": switch(
            textured or cut_out,
            "a material has a texture" if textured else "alpha is looked up as a texture's",
            "no material has a texture",
        ),
        "TEXTURE_LEVELS": _texture_levels(scene, settings),
        "MATERIAL_CELLS": _material_cells(settings, materials),
        "ALPHA": Feature(
            (2 if blended else 1) if cut_out else 0,
            ("a material blends" if blended else "a material is cut out by its alpha")
            if cut_out
            else "no material is cut out",
        ),
        "BACK_FACES": _back_faces(settings, materials),
        "VERTEX_COLORS": switch(
            any(shape.mesh.colors is not None for shape in shapes),
            "a mesh has colours",
            "no mesh has colours",
        ),
        "TANGENTS": switch(
            any(has_tangents(m) for m in materials),
            "a material has a normal map or is anisotropic",
            "no material has a normal map or is anisotropic",
        ),
        "SMOOTH": switch(
            any(shape.mesh.normals is not None for shape in shapes),
            "a mesh has shading normals",
            "no mesh has shading normals",
        ),
        "GLOSSY": switch(
            glossy,
            "a material has a coat or is a metal",
            "every material is matt",
        ),
        "TRANSMISSION": switch(
            any(lets_through(m) for m in materials),
            "a material lets light through",
            "no material lets light through",
        ),
        "LAYERS": switch(
            any(has_layers(m) for m in materials),
            "a material has a clear coat, sheen, anisotropy or a coloured reflection",
            "no material has a clear coat, sheen, anisotropy or a coloured reflection",
        ),
        "AREA_LIGHTS": switch(glows, "a shape emits", "no shape emits"),
        "RECTANGLES": rectangles,
        "SPHERES": spheres,
        "PUNCTUAL_LIGHTS": switch(
            bool(lights),
            f"{len(lights)} lights without extent",
            "no point, spot or directional light",
        ),
        "ENVIRONMENT": Feature(
            (2 if image else 1) if sky else 0,
            ("an environment image" if image else "a constant sky")
            if sky
            else "the environment is black",
        ),
        "CONNECT": connected,
        "LIGHT_SAMPLING": chosen,
        "VIRTUAL_LIGHTS": _virtual_lights(settings, connected),
        "SHADOW_RAYS": _shadow_rays(settings, connected, chosen),
        "LENS": _lens(scene),
        "MOTION": _motion(scene),
        "AOV_DIRECT": switch(
            bool(outputs & {"direct", "indirect"}),
            "direct or indirect was asked for",
            "neither direct nor indirect was asked for",
        ),
        "AOV_FEATURES": switch(
            bool(feature_aovs),
            f"{', '.join(sorted(feature_aovs))} asked for",
            "no albedo, normal or depth was asked for",
        ),
        "AOV_BOUNCES": switch(
            "bounces" in outputs, "bounces asked for", "bounces were not asked for"
        ),
        "AOV_GUIDE": _aov_guide(settings, outputs),
        "GUIDE": switch(
            settings.guiding == "learned",
            "guiding is learned",
            "guiding is off",
        ),
        "CACHE": switch(
            settings.termination == "cache",
            "termination is cache",
            f"termination is {settings.termination}",
        ),
        "CELLS": _cells(settings, glossy, sky),
        "CELL_LAYERS": _cell_layers(settings, glossy),
        "SPARSE": _sparse(settings),
        "WALLS": _walls(settings),
        "AOV_CELLS": _aov_cells(settings, outputs),
        "RESTORE": restores(settings),
        "FIREFLIES": switch(
            settings.filter_fireflies,
            "filter_fireflies dims what few samples speak for",
            "filter_fireflies is false",
        ),
        "SEEN": _seen(settings, outputs),
        "BASE": _base(settings, glossy),
        "METROPOLIS": switch(
            settings.integrator == "metropolis",
            "integrator is metropolis",
            "integrator is path",
        ),
    }


def _texture_levels(scene: Scene, settings: Settings) -> Feature:
    """Return whether later vertices look up smaller textures, and why."""
    if settings.texture_level == "full":
        return Feature(0, "texture_level is full")
    if settings.max_depth == 0:
        return Feature(0, "max_depth is 0: there are no later vertices")
    count = len(leveled_textures(scene))
    if not count:
        return Feature(0, "no material has a texture of more than a texel that may be blurred")
    return Feature(1, f"later vertices see {count} textures as coarsely as paths are apart")


def _material_cells(settings: Settings, materials: list[Material]) -> Feature:
    """Return whether later vertices fetch what textures give once a cell, and why."""
    if settings.material_cache == "off":
        return Feature(0, "material_cache is off")
    if settings.max_depth == 0:
        return Feature(0, "max_depth is 0: there are no later vertices")
    if not any(m.base_color_texture >= 0 or m.metallic_roughness_texture >= 0 for m in materials):
        return Feature(0, "no material has a texture of its base colour, or of roughness and metal")
    return Feature(1, "later vertices fetch what textures give once a cell")


def _rectangles(scene: Scene, settings: Settings, connected: bool) -> Feature:
    """Return whether there are lights that are sampled by the solid angle that they fill."""
    if not connected:
        return Feature(0, "no light is sampled")
    if settings.area_sampling != "solid_angle":
        return Feature(0, f"area_sampling is {settings.area_sampling}")
    count, _ = count_whole_lights(scene, "rectangles")
    if not count:
        return Feature(0, "no rectangle or disk that stands still and glows evenly")
    return Feature(1, f"{count} lights are flat, sampled by the solid angle that they fill")


def _spheres(scene: Scene, settings: Settings, connected: bool) -> Feature:
    """Return whether there are spheres that are sampled by what is seen of them."""
    if not connected:
        return Feature(0, "no light is sampled")
    if settings.area_sampling == "area":
        return Feature(0, "area_sampling is area")
    count, triangles = count_whole_lights(scene, "spheres")
    if not count:
        return Feature(0, "no sphere that stands still and glows evenly")
    return Feature(
        1, f"{count} lights are spheres ({triangles} triangles), sampled as they are seen"
    )


def whole_kinds(features: Mapping[str, Feature]) -> set[str]:
    """Return which kinds of lights are more than a triangle, as `find_whole_lights` names them."""
    names = {"RECTANGLES": "rectangles", "SPHERES": "spheres"}
    return {kind for name, kind in names.items() if features[name].value}


def _back_faces(settings: Settings, materials: list[Material]) -> Feature:
    """Return whether the camera looks through backs."""
    if settings.back_faces == "shown":
        return Feature(0, "back_faces is shown")
    if not any(hides_back(material) for material in materials):
        return Feature(0, "no material is said to be single-sided, or only glass")
    return Feature(1, "the camera looks through the backs of single-sided materials")


def _motion(scene: Scene) -> Feature:
    """Return whether triangles move between frames."""
    moving = count_moving(scene)
    if moving is None:
        return Feature(0, "no triangle moves")
    return Feature(1, f"{moving.triangles} triangles move between frames")


def restores(settings: Settings) -> Feature:
    """Return whether what averages per cell lost is added back to the picture."""
    if settings.path_filter == "off":
        return Feature(0, "path_filter is off")
    if settings.path_filter != "hash_grid":
        return Feature(0, "what averages over balls lost is not put back")
    if not settings.filter_restore:
        return Feature(0, "filter_restore is false: averages stay as they are")
    if settings.screen_filter != "off" or settings.temporal != "off":
        return Feature(0, "screen_filter or temporal is on, and goes on with the averages")
    return Feature(1, "filter_restore puts back what averages per cell lost")


def _aov_cells(settings: Settings, outputs: frozenset[str]) -> Feature:
    """Return whether pixels keep what they saw of cells."""
    asked = sorted(outputs & set(cells.VIEWS))
    if settings.path_filter != "hash_grid":
        return Feature(0, f"path_filter is {settings.path_filter}")
    if not asked:
        return Feature(0, "no image of cells was asked for")
    return Feature(1, f"{', '.join(asked)} asked for")


def _aov_guide(settings: Settings, outputs: frozenset[str]) -> Feature:
    """Return whether the guide is shown.

    Raises:
        InputError: it is asked for, but not among all images, and there is none.
    """
    asked = sorted(outputs & set(guide.VIEWS))
    if settings.guiding == "off":
        if asked and outputs != set(AOVS):
            raise InputError(f"--aov: {', '.join(asked)} needs guiding=learned; got guiding=off")
        return Feature(0, "guiding is off")
    if not asked:
        return Feature(0, "no image of the guide was asked for")
    return Feature(1, f"{', '.join(asked)} asked for")


def _aov_lights(outputs: frozenset[str], chosen: Feature) -> Feature:
    """Return whether pixels keep how their lights were chosen: 2 with what photons say."""
    asked = sorted(outputs & {"light_pmf", *photons.VIEWS})
    if not asked:
        return Feature(0, "no image of the choice of lights was asked for")
    return Feature(2 if chosen.value >= 2 else 1, f"{', '.join(asked)} asked for")


def _without_light_aovs(outputs: frozenset[str], features: dict[str, Feature]) -> frozenset[str]:
    """Return ``outputs`` without those of choices not made, if all are asked for.

    Raises:
        InputError: some, not all, are asked for, and one of them is of such a choice.
    """
    missing = {}
    if not features["CONNECT"].value:
        missing["light_pmf"] = f"a light to choose; {features['CONNECT'].reason}"
    chosen = features["LIGHT_SAMPLING"]
    if chosen.value < 2:
        missing |= dict.fromkeys(photons.VIEWS, f"light_sampling=photon; {chosen.reason}")
    if outputs >= set(AOVS):
        return outputs - missing.keys()
    for name in sorted(outputs & missing.keys()):
        raise InputError(f"--aov: {name} needs {missing[name]}")
    return outputs


def _sparse(settings: Settings) -> Feature:
    """Return whether cells with few samples give way to wider ones."""
    if settings.path_filter != "hash_grid":
        return Feature(0, f"path_filter is {settings.path_filter}")
    if settings.cell_min_count <= 1:
        return Feature(0, "cell_min_count asks for no samples beside the own one")
    return Feature(1, f"cell_min_count asks for {settings.cell_min_count} samples in a cell")


def _cell_layers(settings: Settings, glossy: bool) -> Feature:
    """Return whether what coats and metals reflect is shared where that is wide."""
    if settings.path_filter != "hash_grid":
        return Feature(0, f"path_filter is {settings.path_filter}")
    if not settings.cell_layers:
        return Feature(0, "cell_layers is false: what coats and metals reflect is not shared")
    if not glossy:
        return Feature(0, "every material is matt")
    return Feature(1, "cell_layers shares what wide coats and metals reflect, with diffuse light")


def _walls(settings: Settings) -> Feature:
    """Return whether walls inside cells keep light apart."""
    if settings.path_filter != "hash_grid":
        return Feature(0, f"path_filter is {settings.path_filter}")
    if not settings.cell_walls:
        return Feature(0, "cell_walls is false: light leaks through thin walls")
    return Feature(1, "cell_walls keeps light apart that a wall inside a cell separates")


def _lens(scene: Scene) -> Feature:
    """Return how rays leave the camera."""
    camera = scene.cameras[scene.camera] if scene.cameras else None
    if camera is not None and camera.height > 0.0:
        return Feature(2, "the camera is orthographic")
    if camera is not None and camera.lens_radius > 0.0:
        return Feature(1, "the camera has a lens")
    return Feature(0, "the camera is a pinhole")


def _cells(settings: Settings, glossy: bool, sky: bool) -> Feature:
    """Return whether light is shared per cell, and if so how much of it."""
    if settings.path_filter == "off":
        return Feature(0, "path_filter is off")
    name = f"path_filter is {settings.path_filter}"
    light = "indirect light"
    if settings.filter_direct:
        light = "all light"
    elif settings.filter_sky and sky:
        light = "indirect light and what is even of the sky"
    if glossy:
        layers = _cell_layers(settings, glossy).value
        surfaces = "diffuse bases and wide reflections" if layers else "diffuse bases"
        return Feature(2, f"{name}: shares {light} of {surfaces}")
    return Feature(1, f"{name}: shares {light}; every material is matt")


def _temporal(scene: Scene, settings: Settings, features: dict[str, Feature]) -> Feature:
    """Return whether frames share light: 2 if they also look for where it changes."""
    if settings.temporal == "off":
        return Feature(0, "temporal is off")
    if settings.temporal != "adaptive":
        return Feature(1, f"temporal is {settings.temporal}")
    if not features["CONNECT"].value:
        return Feature(1, "temporal is adaptive, but no light is sampled whose changes probes see")
    if count_moving(scene) is None and not lights_change(scene):
        return Feature(1, "temporal is adaptive, but nothing changes the light")
    return Feature(2, "temporal is adaptive: probes look for changes of light")


def _cell_history(settings: Settings, features: dict[str, Feature]) -> Feature:
    """Return whether cells keep what they know: 2 if they ask for changes of the light."""
    if settings.temporal == "off":
        return Feature(0, "temporal is off")
    if settings.path_filter != "hash_grid":
        return Feature(0, f"path_filter is {settings.path_filter}")
    if settings.cell_history == 0.0:
        return Feature(0, "cell_history is 0: cells begin anew with each frame")
    value = features["TEMPORAL"].value
    return Feature(value, f"cells keep their light for {settings.cell_history:g} s unseen")


def _seen(settings: Settings, outputs: frozenset[str]) -> Feature:
    """Return whether the first surfaces are kept: 2 with where they were in the frame before."""
    if settings.temporal != "off":
        return Feature(2, "frames share light where they see the same")
    if "motion" in outputs:
        return Feature(2, "motion was asked for")
    if settings.screen_filter != "off":
        return Feature(1, "screen_filter compares what pixels see")
    if settings.guiding != "off" and outputs & set(guide.VIEWS):
        return Feature(1, "the guide is shown at what pixels see")
    return Feature(0, "neither screen_filter nor temporal is on, nor motion or guide asked for")


def _base(settings: Settings, glossy: bool) -> Feature:
    """Return whether what first surfaces reflect is kept apart, and if so how much of it."""
    if settings.screen_filter == "off":
        return Feature(0, "screen_filter is off")
    if glossy:
        return Feature(2, "screen_filter averages the light of diffuse bases")
    return Feature(1, "screen_filter averages all light that is reflected; every material is matt")


def all_on(features: dict[str, Feature], settings: Settings) -> dict[str, Feature]:
    """Return the features with those that are off turned on.

    What is on keeps its value: as an image of one texel a constant sky would be sampled otherwise.
    """
    twos = ("ALPHA", "ENVIRONMENT", "CELLS", "CELL_HISTORY", "BASE", "SEEN", "TEMPORAL")
    most = dict.fromkeys(twos, 2)
    full = {
        name: feature
        if feature.value
        else Feature(most.get(name, 1), f"on for measuring, though {feature.reason}")
        for name, feature in features.items()
    }
    # A list of triangles is what small scenes have in place of something.
    full["FEW"] = Feature(0, f"a tree for measuring, though {features['FEW'].reason}")
    # Neither are there places of what is there once.
    full["INSTANCES"] = features["INSTANCES"]
    # Other lights would be drawn, or other points of them: another image.
    full["LIGHT_SAMPLING"] = features["LIGHT_SAMPLING"]
    full["RECTANGLES"] = features["RECTANGLES"]
    full["SPHERES"] = features["SPHERES"]
    full["SHADOW_RAYS"] = features["SHADOW_RAYS"]
    # Photons would stand for what paths bring.
    full["VIRTUAL_LIGHTS"] = features["VIRTUAL_LIGHTS"]
    # Other texels would be read.
    full["TEXTURE_LEVELS"] = features["TEXTURE_LEVELS"]
    # Chains are another integrator, which has no images beside the one.
    full["METROPOLIS"] = features["METROPOLIS"]
    # Directions would be drawn otherwise: the image would have other noise.
    full["GUIDE"] = features["GUIDE"]
    full["AOV_GUIDE"] = features["AOV_GUIDE"]
    # Paths would end elsewhere.
    full["CACHE"] = features["CACHE"]
    # Pixels would be dimmed.
    full["FIREFLIES"] = features["FIREFLIES"]
    # Other light would be shared.
    full["CELL_LAYERS"] = features["CELL_LAYERS"]
    # Means of texels would be read.
    full["MATERIAL_CELLS"] = features["MATERIAL_CELLS"]
    if features["METROPOLIS"].value:
        names = (
            "AOV_BOUNCES",
            "AOV_CELLS",
            "AOV_DIRECT",
            "AOV_FEATURES",
            "AOV_LIGHTS",
            "BASE",
            "CELLS",
            "CELL_HISTORY",
            "RESTORE",
            "SEEN",
            "SPARSE",
            "WALLS",
        )
        full |= {name: features[name] for name in names}
    if settings.path_filter == "range_search":
        # There are no cells.
        full["CELL_HISTORY"] = features["CELL_HISTORY"]
    # Without anything to move there is nothing to hold.
    full["MOTION"] = features["MOTION"]
    return full


def _connect(settings: Settings, extended: bool, punctual: bool) -> Feature:
    """Return whether lights are sampled, and why."""
    if not (extended or punctual):
        return Feature(0, "the scene has no light")
    if settings.max_depth == 0:
        return Feature(0, "max_depth is 0: nothing is lit, only seen")
    if settings.direct_sampling == "bsdf" and not punctual:
        return Feature(0, "direct_sampling is bsdf, and every light has an extent")
    return Feature(1, "lights are sampled at every vertex")


def _light_sampling(settings: Settings, connected: bool, lights: int, scene: Scene) -> Feature:
    """Return how lights are drawn, and why."""
    if settings.light_sampling in ("power", "uniform"):
        return Feature(0, f"light_sampling is {settings.light_sampling}: a table of chances")
    if not connected:
        return Feature(0, "no light is sampled")
    if lights == 1:
        return Feature(0, "there is one light: nothing to choose")
    if settings.light_sampling == "auto":
        if lights < MANY_LIGHTS:
            return Feature(0, f"light_sampling is auto: a table of {lights} lights is fast")
        if (spread := light_spread(scene)) < SPREAD_LIGHTS:
            why = f"{lights} lights are together in {spread:.2g} of the scene's length"
            return Feature(0, f"light_sampling is auto: {why}")
        if settings.integrator == "metropolis":
            return Feature(1, f"light_sampling is auto, without photons: a tree of {lights} lights")
        return Feature(2, f"light_sampling is auto: photons of {lights} lights say which are seen")
    if settings.light_sampling == "hierarchy":
        return Feature(1, f"light_sampling is hierarchy: a tree of {lights} lights")
    if settings.light_sampling == "photon_origin":
        return Feature(
            3, f"light_sampling is photon_origin: rays go where photons of {lights} lights began"
        )
    return Feature(2, f"light_sampling is photon: photons of {lights} lights say which are seen")


def _virtual_lights(settings: Settings, connected: Feature) -> Feature:
    """Return whether photons stand for light that is reflected more than once."""
    if settings.indirect_light == "paths":
        return Feature(0, "indirect_light is paths")
    if not connected.value:
        return Feature(0, connected.reason)
    if settings.max_depth < 2:
        return Feature(0, f"max_depth is {settings.max_depth}: light is reflected once at most")
    return Feature(1, "indirect_light is virtual_lights: photons stand for reflected light")


def _shadow_rays(settings: Settings, connected: Feature, chosen: Feature) -> Feature:
    """Return how many rays to lights a vertex has at most, 0 for one."""
    if not connected.value:
        return Feature(0, connected.reason)
    if _virtual_lights(settings, connected).value:
        return Feature(2, "indirect_light is virtual_lights: one more ray goes to one of these")
    if settings.shadow_rays == "1":
        return Feature(0, "shadow_rays is 1")
    if settings.shadow_rays != "auto":
        return Feature(int(settings.shadow_rays), f"shadow_rays is {settings.shadow_rays}")
    if chosen.value < 2:
        return Feature(0, "shadow_rays is auto: one, without photons that say how many lights")
    return Feature(
        photons.MOST_RAYS,
        "shadow_rays is auto: from what is seen, one for each light that is known",
    )


def light_count(scene: Scene, kinds: Collection[str]) -> int:
    """Return the entries of the light table, or a few more; one for each light of ``kinds``."""
    emitting = sum(
        len(shape.mesh.triangles)
        for shape in scene.shapes
        if emits(scene.materials[shape.material])
    )
    for kind in kinds:
        count, triangles = count_whole_lights(scene, kind)
        emitting -= triangles - count
    return emitting + sum(map(shines, scene.lights)) + has_environment(scene.environment)
