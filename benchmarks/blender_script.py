"""What Blender does, in its own interpreter: characters made and exported, and files posed.

`python blender_script.py make FOLDER` writes characters and what Blender's own vertices are in
every frame; `python blender_script.py pose FOLDER FILE...` imports files and does the same.
"""

import json
import math
import random
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector


def clear():
    bpy.ops.wm.read_factory_settings(use_empty=True)


def bone_chain(armature, name, parent, head, step, count):
    """Bones one after the other."""
    bones, last = armature.data.edit_bones, parent
    made = []
    for k in range(count):
        bone = bones.new(f"{name}_{k}")
        bone.head, bone.tail = head, head + step
        bone.parent = last
        bone.roll = 0.3 * k
        head, last = bone.tail.copy(), bone
        made.append(bone.name)
    return made


def skeleton(rng, scale):
    """A trunk, four limbs, a head and a tail: 27 bones."""
    armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    names = bone_chain(armature, "spine", None, Vector((0, 0, 0.9)), Vector((0, 0.02, 0.15)), 4)
    bones = armature.data.edit_bones
    top, hip = bones["spine_3"], bones["spine_0"]
    names += bone_chain(armature, "head", top, top.tail.copy(), Vector((0, 0, 0.12)), 2)
    for side, sign in (("l", 1), ("r", -1)):
        start = top.tail + Vector((0.15 * sign, 0, -0.05))
        names += bone_chain(armature, f"arm_{side}", top, start, Vector((0.22 * sign, 0, 0)), 4)
        start = hip.head + Vector((0.1 * sign, 0, -0.05))
        names += bone_chain(armature, f"leg_{side}", hip, start, Vector((0, 0.01, -0.28)), 4)
    names += bone_chain(armature, "tail", hip, hip.head.copy(), Vector((0, 0.12, -0.02)), 5)
    bpy.ops.object.mode_set(mode="OBJECT")
    armature.scale = (scale,) * 3
    armature.rotation_euler = [rng.uniform(-0.5, 0.5) for _ in range(3)]
    armature.location = [rng.uniform(-1, 1) for _ in range(3)]
    return armature, names


def tubes(armature, names):
    """Vertices, quads and weights of a tube around each bone, with texture coordinates."""
    vertices, faces, weights = [], [], []
    for name in names:
        bone = armature.data.bones[name]
        head, tail = bone.head_local, bone.tail_local
        axis = (tail - head).normalized()
        side = axis.orthogonal().normalized()
        other = axis.cross(side)
        first, rings, sectors = len(vertices), 6, 12
        for ring in range(rings):
            t = ring / (rings - 1)
            round_end = math.sqrt(max(1 - (2 * t - 1) ** 8, 0.05))
            for k in range(sectors):
                a = 2 * math.pi * k / sectors
                radius = 0.05 * round_end
                vertices.append(
                    head + (tail - head) * t + radius * (math.cos(a) * side + math.sin(a) * other)
                )
                own = {name: 1.0}
                if bone.parent is not None and t < 0.4:
                    own = {name: 0.5 + t, bone.parent.name: 0.5 - t}
                for child in bone.children:
                    if t > 0.6:
                        own[child.name] = own.get(child.name, 0) + 0.4 * (t - 0.5)
                weights.append(own)
        for ring in range(rings - 1):
            for k in range(sectors):
                a, b = first + ring * sectors + k, first + ring * sectors + (k + 1) % sectors
                faces.append((a, b, b + sectors, a + sectors))
        faces.append(tuple(first + k for k in reversed(range(sectors))))
        faces.append(tuple(first + (rings - 1) * sectors + k for k in range(sectors)))
    return vertices, faces, weights


def skinned(armature, names, title, materials, rng, keys):
    vertices, faces, weights = tubes(armature, names)
    mesh = bpy.data.meshes.new(title)
    mesh.from_pydata([tuple(v) for v in vertices], [], faces)
    thing = bpy.data.objects.new(title, mesh)
    bpy.context.collection.objects.link(thing)
    for k in range(materials):
        mesh.materials.append(bpy.data.materials.new(f"{title} {k}"))
    for polygon in mesh.polygons:
        polygon.material_index = polygon.index * materials // len(mesh.polygons)
    layer = mesh.uv_layers.new()
    for loop in mesh.loops:  # seams: every face has its own corner of the texture
        layer.data[loop.index].uv = (rng.random(), rng.random())
    for k, own in enumerate(weights):
        total = sum(own.values())
        for bone, weight in own.items():
            group = thing.vertex_groups.get(bone) or thing.vertex_groups.new(name=bone)
            group.add([k], weight / total, "REPLACE")
    thing.parent = armature
    thing.modifiers.new("Armature", "ARMATURE").object = armature
    if keys:
        thing.shape_key_add(name="Basis")
        for k in range(keys):
            key = thing.shape_key_add(name=f"key {k}", from_mix=False)
            for point in key.data:
                point.co = point.co + 0.03 * Vector([rng.uniform(-1, 1) for _ in range(3)])
    return thing


def animate(armature, things, name, frames, rng, *, stretch):
    """An action of all bones, and of the shape keys."""
    armature.animation_data_create()
    armature.animation_data.action = bpy.data.actions.new(name)
    for bone in armature.pose.bones:
        bone.rotation_mode = "QUATERNION"
        for frame in (1, 1 + frames // 2, 1 + frames):
            angles = [rng.gauss(0, 0.35) for _ in range(3)]
            turn = Matrix.Identity(3)
            for axis, angle in zip("XYZ", angles, strict=False):
                turn = turn @ Matrix.Rotation(angle, 3, axis)
            bone.rotation_quaternion = turn.to_quaternion()
            bone.keyframe_insert("rotation_quaternion", frame=frame)
            if bone.parent is None or (stretch and bone.name.startswith("tail")):
                bone.location = [rng.gauss(0, 0.05) for _ in range(3)]
                bone.keyframe_insert("location", frame=frame)
            if stretch and bone.name.startswith("head"):
                bone.scale = [rng.uniform(0.8, 1.2)] * 3
                bone.keyframe_insert("scale", frame=frame)
    for thing in things:
        if thing.data.shape_keys is None:
            continue
        for key in thing.data.shape_keys.key_blocks[1:]:
            for frame in (1, 1 + frames):
                key.value = rng.random()
                key.keyframe_insert("value", frame=frame)


def evaluated(things):
    """Positions of all vertices as Blender shows them, in the world."""
    graph = bpy.context.evaluated_depsgraph_get()
    rows = []
    for thing in things:
        shown = thing.evaluated_get(graph)
        mesh = shown.to_mesh()
        points = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", points)
        world = np.array(shown.matrix_world)
        rows.append(points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3])
        shown.to_mesh_clear()
    # glTF is y up.
    points = np.concatenate(rows)
    return np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1)


def make(folder):
    """Characters of several kinds, exported, with Blender's vertices of every frame beside them."""
    for number, (scale, parts, materials, keys, stretch) in enumerate(
        [(1.0, 1, 1, 0, False), (1.0, 2, 3, 2, False), (0.4, 3, 2, 3, True)]
    ):
        clear()
        rng = random.Random(number)
        armature, names = skeleton(rng, scale)
        things = [
            skinned(armature, names[k::parts], f"part {k}", materials, rng, keys)
            for k in range(parts)
        ]
        scene = bpy.context.scene
        scene.render.fps, scene.frame_start, scene.frame_end = 24, 1, 25
        animate(armature, things, "move", 24, rng, stretch=stretch)
        path = folder / f"made_{number}.glb"
        bpy.ops.export_scene.gltf(
            filepath=str(path),
            export_animation_mode="ACTIVE_ACTIONS",
            export_all_influences=True,
            export_optimize_animation_size=False,
        )
        record(path, things, range(1, 26), 24)


def record(path, things, frames, fps):
    rows = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        rows.append(evaluated(things))
    first = min(frames)
    np.savez(
        path.with_suffix(".npz"),
        vertices=np.stack(rows),
        times=(np.array(list(frames)) - first) / fps,
        fps=fps,
    )


def pose(folder, paths):
    """Files imported, and one of their animations posed by Blender."""
    for text in paths:
        path, _, name = text.partition("=")
        clear()
        bpy.context.scene.render.fps = 24
        bpy.ops.import_scene.gltf(filepath=path, import_shading="FLAT", merge_vertices=False)
        things = [o for o in bpy.data.objects if o.type == "MESH" and o.find_armature()]
        armature = things[0].find_armature()
        action = next((a for a in bpy.data.actions if a.name.startswith(name)), None)
        if action is None:
            raise SystemExit(f"{path}: no action {name!r} of {[a.name for a in bpy.data.actions]}")
        for thing in (armature, *(t.data.shape_keys for t in things if t.data.shape_keys)):
            thing.animation_data_create()
            strips = [x for t in thing.animation_data.nla_tracks for x in t.strips]
            own = next((strip for strip in strips if strip.action == action), None)
            slot = None if own is None else own.action_slot
            for track in list(thing.animation_data.nla_tracks):
                thing.animation_data.nla_tracks.remove(track)
            if slot is not None:
                thing.animation_data.action = action
                thing.animation_data.action_slot = slot
        first, last = (round(x) for x in action.frame_range)
        record(folder / Path(path).name, things, range(first, last + 1), 24)


if __name__ == "__main__":
    where = Path(sys.argv[2])
    if sys.argv[1] == "make":
        make(where)
    else:
        pose(where, sys.argv[3:])
    print(json.dumps({"blender": bpy.app.version_string}))
