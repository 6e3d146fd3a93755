"""Makes still_life.usdz with the reference implementation: pip install usd-core; python still_life.py"""

import os
import struct
import zlib

from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdUtils, Vt


def png(path, texels):
    """A picture of two by two texels."""
    rows = b"".join(b"\0" + bytes(sum(row, [])) for row in texels)

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", 2, 2, 8, 2, 0, 0, 0)
    with open(path, "wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))


def surface(stage, path, color):
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, path + "/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    color(shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f))
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material


png("wood.png", [[[255, 0, 0], [0, 0, 255]], [[0, 255, 0], [188, 188, 188]]])
stage = Usd.Stage.CreateNew("still_life.usdc")
UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
UsdGeom.SetStageMetersPerUnit(stage, 0.01)
world = UsdGeom.Xform.Define(stage, "/World")
stage.SetDefaultPrim(world.GetPrim())


def textured(slot):
    texture = UsdShade.Shader.Define(stage, "/World/Wood/Texture")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("wood.png")
    reader = UsdShade.Shader.Define(stage, "/World/Wood/Reader")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    slot.ConnectToSource(texture.ConnectableAPI(), "rgb")


wood = surface(stage, "/World/Wood", textured)
plain = surface(stage, "/World/Plain", lambda slot: slot.Set(Gf.Vec3f(0.5, 0.4, 0.3)))

table = UsdGeom.Mesh.Define(stage, "/World/Table")
table.CreateFaceVertexCountsAttr([4, 4])
table.CreateFaceVertexIndicesAttr([0, 1, 4, 3, 1, 2, 5, 4])
table.CreatePointsAttr([(-1, -1, 1), (0, -1, 1), (1, -1, 1), (-1, 1, 1), (0, 1, 1), (1, 1, 1)])
table.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
st = UsdGeom.PrimvarsAPI(table).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
st.Set([(0, 0), (1, 0), (1, 1), (0, 1)] * 2)
UsdShade.MaterialBindingAPI.Apply(table.GetPrim()).Bind(wood)
subset = UsdShade.MaterialBindingAPI(table).CreateMaterialBindSubset("Right", Vt.IntArray([1]))
UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(plain)

leg = stage.CreateClassPrim("/Leg")
cube = UsdGeom.Cube.Define(stage, "/Leg/Cube")
cube.CreateSizeAttr(1.0)
UsdGeom.XformCommonAPI(cube).SetScale((0.1, 0.1, 1.0))
for index, (x, y) in enumerate([(-0.9, -0.9), (0.9, -0.9), (-0.9, 0.9), (0.9, 0.9)]):
    placed = UsdGeom.Xform.Define(stage, f"/World/Leg{index}")
    placed.GetPrim().GetReferences().AddInternalReference("/Leg")
    placed.GetPrim().SetInstanceable(True)
    UsdGeom.XformCommonAPI(placed).SetTranslate((x, y, 0.5))

balls = UsdGeom.PointInstancer.Define(stage, "/World/Balls")
ball = UsdGeom.Sphere.Define(stage, "/World/Balls/Ball")
ball.CreateRadiusAttr(0.2)
ball.CreateDisplayColorAttr([(0.8, 0.1, 0.1)])
balls.CreatePrototypesRel().SetTargets([ball.GetPath()])
balls.CreateProtoIndicesAttr([0, 0, 0])
balls.CreatePositionsAttr([(-0.5, 0, 1.2), (0, 0, 1.2), (0.5, 0, 1.2)])
balls.CreateOrientationsAttr([Gf.Quath(1, 0, 0, 0)] * 3)
balls.CreateScalesAttr([(1, 1, 1), (0.5, 0.5, 0.5), (1, 1, 1)])

sun = UsdLux.DistantLight.Define(stage, "/World/Sun")
sun.CreateIntensityAttr(3)
sun.CreateAngleAttr(0)
lamp = UsdLux.SphereLight.Define(stage, "/World/Lamp")
lamp.CreateTreatAsPointAttr(True)
UsdGeom.XformCommonAPI(lamp).SetTranslate((0, 0, 3))
panel = UsdLux.RectLight.Define(stage, "/World/Panel")
UsdGeom.XformCommonAPI(panel).SetTranslate((0, 0, 4))

camera = UsdGeom.Camera.Define(stage, "/World/Camera")
UsdGeom.XformCommonAPI(camera).SetTranslate((0, -6, 2))
UsdGeom.XformCommonAPI(camera).SetRotate((90, 0, 0))
stage.GetRootLayer().Save()
UsdUtils.CreateNewUsdzPackage("still_life.usdc", "still_life.usdz")
os.remove("still_life.usdc")
os.remove("wood.png")
