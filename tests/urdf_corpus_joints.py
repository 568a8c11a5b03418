"""Corpus: numbers, limits, joint types, mimic joints."""

from __future__ import annotations

import math

from urdf_corpus_case import ARM, AXIS, LIMIT, PARENT, SHOULDER, Case, cases_of, edited


def number_cases() -> list[Case]:
    """Numbers that are none, not finite, or in the wrong number."""
    xyz = "0 0 0.3"
    rows = [
        ("exponents and signs", "accept", edited((xyz, "+1e-1 -.5E0 3."))),
        ("spaces and line breaks", "accept", edited((xyz, "  0\n 0\t0.3  "))),
        ("tiny number", "accept", edited((xyz, "0 0 1e-320"))),
        ("nan position", "refuse:not-finite", edited((xyz, "0 0 nan"))),
        ("NaN rotation", "refuse:not-finite", edited(("0 0 0.1", "0 NaN 0"))),
        ("inf position", "refuse:not-finite", edited((xyz, "inf 0 0"))),
        ("-Infinity", "refuse:not-finite", edited((xyz, "-Infinity 0 0"))),
        ("overflow to inf", "refuse:not-finite", edited((xyz, "1e999 0 0"))),
        ("too large to square", "refuse:not-finite", edited((xyz, "1e200 0 0"))),
        ("a light second away", "refuse:far-away", edited((xyz, "3e8 0 0"))),
        ("decimal comma", "refuse:number", edited((xyz, "0 0 0,3"))),
        ("commas between", "refuse:vector-size", edited((xyz, "0,0,0.3"))),
        ("two numbers", "refuse:vector-size", edited((xyz, "0 0.3"))),
        ("four numbers", "refuse:vector-size", edited((xyz, "0 0 0.3 0"))),
        ("empty vector", "refuse:vector-size", edited((xyz, ""))),
        ("text", "refuse:number", edited((xyz, "0 0 high"))),
        ("hexadecimal", "refuse:number", edited((xyz, "0 0 0x1p3"))),
        ("underscore", "refuse:number", edited((xyz, "0 0 1_0"))),
        ("Arabic digits", "refuse:number", edited((xyz, "0 0 \u0663"))),
        ("full-width digits", "refuse:number", edited((xyz, "0 0 \uff13"))),
        ("unit attached", "refuse:number", edited((xyz, "0 0 0.3m"))),
        ("expression", "refuse:number", edited((xyz, "0 0 1/3"))),
        ("minus sign of typesetters", "refuse:number", edited((xyz, "0 0 \u22120.3"))),
        ("rotation in degrees", "warn", edited(("0 0 0.1", "0 0 90"))),
        ("zero axis", "refuse:axis-zero", edited((AXIS, '<axis xyz="0 0 0"/>'))),
        ("tiny axis", "refuse:axis-norm", edited((AXIS, '<axis xyz="0 0 1e-9"/>'))),
        ("huge axis", "refuse:axis-norm", edited((AXIS, '<axis xyz="0 0 1e9"/>'))),
        ("axis underflows", "refuse:axis-norm", edited((AXIS, '<axis xyz="0 0 1e-200"/>'))),
        ("axis of length 2", "warn", edited((AXIS, '<axis xyz="0 0 2"/>'))),
        ("rounded axis", "accept", edited((AXIS, '<axis xyz="0.7071 0 0.7071"/>'))),
        ("nan axis", "refuse:not-finite", edited((AXIS, '<axis xyz="0 nan 1"/>'))),
        ("axis of two numbers", "refuse:vector-size", edited((AXIS, '<axis xyz="0 1"/>'))),
        ("no axis", "warn", edited((AXIS, ""))),
        ("nan mass", "refuse:not-finite", edited(('<mass value="2"/>', '<mass value="nan"/>'))),
        ("negative mass", "refuse:mass", edited(('<mass value="2"/>', '<mass value="-2"/>'))),
        ("no mass", "warn", edited(('<mass value="2"/>', ""))),
        ("zero mass", "accept", edited(('<mass value="2"/>', '<mass value="0"/>'))),
        ("inf inertia", "refuse:not-finite", edited(('ixx="0.1"', 'ixx="inf"'))),
        ("negative inertia", "warn", edited(('ixx="0.1"', 'ixx="-0.1"'))),
        ("text in effort", "refuse:number", edited(('effort="10"', 'effort="strong"'))),
        ("empty velocity", "refuse:number", edited(('velocity="1"', 'velocity=""'))),
    ]
    return cases_of("numbers", rows)


def limit_cases() -> list[Case]:
    """Limits that a controller cannot live with."""

    def limited(lower: str, upper: str, velocity: str = "1") -> bytes:
        return edited((LIMIT, f'<limit lower="{lower}" upper="{upper}" velocity="{velocity}" effort="1"/>'))

    prismatic = SHOULDER.replace("revolute", "prismatic")
    continuous = SHOULDER.replace("revolute", "continuous")
    rows = [
        ("two full turns each way", "accept", limited(str(-4 * math.pi), str(4 * math.pi))),
        ("above zero only", "accept", limited("1", "2")),
        ("narrow", "accept", limited("0", "1e-6")),
        ("inverted", "refuse:limit-order", limited("1", "-1")),
        ("equal", "refuse:limit-order", limited("0", "0")),
        ("degrees", "refuse:limit-degrees", limited("-180", "180")),
        ("degrees on one side", "refuse:limit-degrees", limited("-1", "170")),
        ("unlimited by a large number", "warn", limited("-1e16", "1e16")),
        ("infinite", "refuse:not-finite", limited("-inf", "inf")),
        ("nan", "refuse:not-finite", limited("nan", "1")),
        ("no lower", "warn", edited(('lower="-2" ', ""))),
        ("no upper", "warn", edited(('upper="2.5" ', ""))),
        ("no limit", "warn", edited((LIMIT, ""))),
        ("limit twice", "refuse:element-twice", edited((LIMIT, LIMIT + LIMIT))),
        ("velocity zero", "warn", limited("-1", "1", "0")),
        ("velocity negative", "warn", limited("-1", "1", "-3")),
        ("velocity nan", "refuse:not-finite", limited("-1", "1", "nan")),
        ("no velocity", "warn", edited(('velocity="1" ', ""))),
        ("no effort", "accept", edited((' effort="10"', ""))),
        ("long slide", "accept", edited((SHOULDER, prismatic), (LIMIT, LIMIT.replace("2.5", "50")))),
        ("slide without limits", "warn", edited((SHOULDER, prismatic), (LIMIT, ""))),
        ("slide with equal limits", "refuse:limit-order", edited((SHOULDER, prismatic), ("-2", "2.5"))),
        ("continuous with limits", "accept", edited((SHOULDER, continuous))),
        ("continuous without", "accept", edited((SHOULDER, continuous), (LIMIT, ""))),
        ("continuous, inverted", "accept", edited((SHOULDER, continuous), ("-2", "3"))),
        ("continuous, velocity zero", "warn", edited((SHOULDER, continuous), ('"1" e', '"0" e'))),
        ("inverted but locked", "accept", limited("1", "-1"), {"options": {"locked": ("shoulder",)}}),
        ("degrees but locked", "accept", limited("-180", "180"), {"options": {"locked": ("shoulder",)}}),
    ]
    return cases_of("limits", rows)


def type_cases() -> list[Case]:
    """Joint types, known and unknown."""

    def typed(kind: str, *more: tuple[str, str]) -> bytes:
        return edited((SHOULDER, f'<joint name="shoulder" type="{kind}">'), *more)

    rows = [
        ("prismatic", "accept", typed("prismatic")),
        ("continuous", "accept", typed("continuous")),
        ("fixed", "accept", typed("fixed")),
        ("floating", "accept", typed("floating")),
        ("planar", "accept", typed("planar")),
        ("planar about x", "refuse:planar-axis", typed("planar", (AXIS, '<axis xyz="1 0 0"/>'))),
        ("planar downwards", "refuse:planar-axis", typed("planar", (AXIS, '<axis xyz="0 0 -1"/>'))),
        ("planar without axis", "refuse:planar-axis", typed("planar", (AXIS, ""))),
        ("floating with zero axis", "accept", typed("floating", (AXIS, '<axis xyz="0 0 0"/>'))),
        ("fixed with zero axis", "accept", typed("fixed", (AXIS, '<axis xyz="0 0 0"/>'))),
        ("fixed with limits of nonsense", "accept", typed("fixed", ("-2", "9"))),
        ("fixed with nan limit", "refuse:not-finite", typed("fixed", ("-2", "nan"))),
        ("ball", "refuse:joint-type", typed("ball")),
        ("spherical", "refuse:joint-type", typed("spherical")),
        ("screw", "refuse:joint-type", typed("screw")),
        ("capital letter", "refuse:joint-type", typed("Revolute")),
        ("misspelt", "refuse:joint-type", typed("revolut")),
        ("space after", "refuse:joint-type", typed("revolute ")),
        ("no type", "refuse:joint-type", edited((SHOULDER, '<joint name="shoulder">'))),
        ("empty type", "refuse:joint-type", typed("")),
        ("unknown, child of unknown", "refuse:joint-type", typed("universal", (PARENT, ""))),
        ("floating base", "accept", ARM.encode(), {"options": {"base": "floating"}}),
        ("planar base", "accept", ARM.encode(), {"options": {"base": "planar"}}),
        (
            "floating base, joint of its name",
            "refuse:name-reserved",
            edited(("elbow", "root_joint")),
            {"options": {"base": "floating"}},
        ),
        ("joint of that name, fixed base", "accept", edited(("elbow", "root_joint"))),
    ]
    return cases_of("joint types", rows)


def mimic_cases() -> list[Case]:
    """Joints that follow others."""
    fixed = SHOULDER.replace("revolute", "fixed")
    turning = SHOULDER.replace("revolute", "continuous")

    def following(elbow: str, shoulder: str = "", *more: tuple[str, str]) -> bytes:
        return edited(*more, (LIMIT, LIMIT + shoulder), ('velocity="3" effort="20"/>', f'velocity="3"/>{elbow}'))

    plain = '<mimic joint="shoulder"/>'
    rows = [
        ("plain", "warn", following(plain)),  # the follower's narrower limits bind its leader
        ("within the leader's limits", "accept", following('<mimic joint="shoulder" multiplier="0.4"/>')),
        ("parent that comes later", "warn", following("", '<mimic joint="elbow" multiplier="2"/>')),
        ("factor and offset", "accept", following('<mimic joint="shoulder" multiplier="-0.3" offset="0.2"/>')),
        ("never within the limits", "warn", following('<mimic joint="shoulder" multiplier="0.1" offset="9"/>')),
        ("factor zero", "warn", following('<mimic joint="shoulder" multiplier="0"/>')),
        ("huge factor", "refuse:mimic-multiplier", following('<mimic joint="shoulder" multiplier="1e9"/>')),
        ("nan factor", "refuse:not-finite", following('<mimic joint="shoulder" multiplier="nan"/>')),
        ("text factor", "refuse:number", following('<mimic joint="shoulder" multiplier="twice"/>')),
        ("infinite offset", "refuse:not-finite", following('<mimic joint="shoulder" offset="inf"/>')),
        ("itself", "refuse:mimic-cycle", following('<mimic joint="elbow"/>')),
        ("each other", "refuse:mimic-cycle", following(plain, '<mimic joint="elbow"/>')),
        ("unknown joint", "refuse:mimic-unknown", following('<mimic joint="sholder"/>')),
        ("a link's name", "refuse:mimic-unknown", following('<mimic joint="base"/>')),
        ("no joint named", "refuse:mimic-leader", following("<mimic/>")),
        ("two mimics", "refuse:element-twice", following(plain + plain)),
        ("fixed leader", "warn", following(plain, "", (SHOULDER, fixed))),
        ("fixed follower", "warn", following("", '<mimic joint="elbow"/>', (SHOULDER, fixed))),
        ("floating leader", "refuse:mimic-type", following(plain, "", (SHOULDER, fixed.replace("fixed", "floating")))),
        ("planar follower", "refuse:mimic-type", following("", plain.replace("shoulder", "elbow"), _planar())),
        ("continuous leader", "warn", following(plain, "", (SHOULDER, turning))),
        (
            "continuous leader, half speed",
            "warn",
            following(plain.replace("/>", ' multiplier="0.5"/>'), "", _turning()),
        ),
        ("leader locked", "accept", following(plain), {"options": {"locked": ("shoulder",)}}),
        ("both locked", "accept", following(plain), {"options": {"locked": ("elbow", "shoulder")}}),
        ("follower locked", "refuse:locked-follower", following(plain), {"options": {"locked": ("elbow",)}}),
        (
            "unknown leader, follower locked",
            "accept",
            following('<mimic joint="gone"/>'),
            {"options": {"locked": ("elbow",)}},
        ),
        ("mimic of mimic, backwards", "accept", mimic_chain((2, 1, 0))),
        ("mimic of mimic, forwards", "accept", mimic_chain((0, 1, 2))),
        ("mimic of mimic of fixed", "warn", mimic_chain((0, 1, 2)).replace(b"revolute", b"fixed", 1)),
        ("unknown attribute", "warn", following(plain.replace("/>", ' factor="2"/>'))),
    ]
    return cases_of("mimic", rows)


def mimic_chain(order: tuple[int, ...]) -> bytes:
    """Three joints, each following the one before, written in some order."""
    limit = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
    joints = [
        f'<joint name="j{i}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/><origin xyz="0.2 0 0"/>'
        f'<axis xyz="0 0 1"/>{limit}' + (f'<mimic joint="j{i - 1}" multiplier="-0.5"/>' if i else "") + "</joint>"
        for i in range(3)
    ]
    links = "".join(f'<link name="l{i}"/>' for i in range(4))
    return f'<robot name="chain">{links}{"".join(joints[i] for i in order)}</robot>'.encode()


def _planar() -> tuple[str, str]:
    return (SHOULDER, SHOULDER.replace("revolute", "planar"))


def _turning() -> tuple[str, str]:
    return (SHOULDER, SHOULDER.replace("revolute", "continuous"))
