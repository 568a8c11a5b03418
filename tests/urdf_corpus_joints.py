"""Corpus: numbers, limits, joint types, mimic joints."""

from __future__ import annotations

import math

from urdf_corpus_case import ARM, AXIS, LIMIT, SHOULDER, Case, cases_of, edited


def number_cases() -> list[Case]:
    """Numbers that are none, not finite, or in the wrong number."""
    xyz = "0 0 0.3"
    rows = [
        ("exponents and signs", "accept", edited((xyz, "+1e-1 -.5E0 3."))),
        ("spaces and line breaks", "accept", edited((xyz, "  0\n 0\t0.3  "))),
        ("tiny number", "accept", edited((xyz, "0 0 1e-320"))),
        ("nan position", "refuse:not-finite", edited((xyz, "0 0 nan"))),
        ("inf position", "refuse:not-finite", edited((xyz, "inf 0 0"))),
        ("overflow to inf", "refuse:not-finite", edited((xyz, "1e999 0 0"))),
        ("a light second away", "refuse:far-away", edited((xyz, "3e8 0 0"))),
        ("decimal comma", "refuse:number", edited((xyz, "0 0 0,3"))),
        ("commas between", "refuse:vector-size", edited((xyz, "0,0,0.3"))),
        ("two numbers", "refuse:vector-size", edited((xyz, "0 0.3"))),
        ("empty vector", "refuse:vector-size", edited((xyz, ""))),
        ("text", "refuse:number", edited((xyz, "0 0 high"))),
        ("Arabic digits", "refuse:number", edited((xyz, "0 0 \u0663"))),
        ("minus sign of typesetters", "refuse:number", edited((xyz, "0 0 \u22120.3"))),
        ("rotation in degrees", "warn", edited(("0 0 0.1", "0 0 90"))),
        ("zero axis", "refuse:axis-zero", edited((AXIS, '<axis xyz="0 0 0"/>'))),
        ("tiny axis", "refuse:axis-norm", edited((AXIS, '<axis xyz="0 0 1e-9"/>'))),
        ("axis of length 2", "warn", edited((AXIS, '<axis xyz="0 0 2"/>'))),
        ("rounded axis", "accept", edited((AXIS, '<axis xyz="0.7071 0 0.7071"/>'))),
        ("no axis", "warn", edited((AXIS, ""))),
        ("negative mass", "refuse:mass", edited(('<mass value="2"/>', '<mass value="-2"/>'))),
        ("no mass", "warn", edited(('<mass value="2"/>', ""))),
        ("negative inertia", "warn", edited(('ixx="0.1"', 'ixx="-0.1"'))),
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
        ("inverted", "refuse:limit-order", limited("1", "-1")),
        ("equal", "refuse:limit-order", limited("0", "0")),
        ("degrees", "refuse:limit-degrees", limited("-180", "180")),
        ("unlimited by a large number", "warn", limited("-1e16", "1e16")),
        ("infinite", "refuse:not-finite", limited("-inf", "inf")),
        ("no lower", "warn", edited(('lower="-2" ', ""))),
        ("no upper", "warn", edited(('upper="2.5" ', ""))),
        ("no limit", "warn", edited((LIMIT, ""))),
        ("limit twice", "refuse:element-twice", edited((LIMIT, LIMIT + LIMIT))),
        ("velocity zero", "warn", limited("-1", "1", "0")),
        ("velocity negative", "warn", limited("-1", "1", "-3")),
        ("no velocity", "warn", edited(('velocity="1" ', ""))),
        ("slide without limits", "warn", edited((SHOULDER, prismatic), (LIMIT, ""))),
        ("continuous with limits", "accept", edited((SHOULDER, continuous))),
        ("continuous without", "accept", edited((SHOULDER, continuous), (LIMIT, ""))),
        ("continuous, inverted", "accept", edited((SHOULDER, continuous), ("-2", "3"))),
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
        ("planar", "accept", typed("planar")),
        ("planar about x", "refuse:planar-axis", typed("planar", (AXIS, '<axis xyz="1 0 0"/>'))),
        ("planar without axis", "refuse:planar-axis", typed("planar", (AXIS, ""))),
        ("floating with zero axis", "accept", typed("floating", (AXIS, '<axis xyz="0 0 0"/>'))),
        ("fixed with limits of nonsense", "accept", typed("fixed", ("-2", "9"))),
        ("fixed with nan limit", "refuse:not-finite", typed("fixed", ("-2", "nan"))),
        ("ball", "refuse:joint-type", typed("ball")),
        ("misspelt", "refuse:joint-type", typed("revolut")),
        ("space after", "refuse:joint-type", typed("revolute ")),
        ("no type", "refuse:joint-type", edited((SHOULDER, '<joint name="shoulder">'))),
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

    def following(elbow: str, shoulder: str = "", *more: tuple[str, str]) -> bytes:
        return edited(*more, (LIMIT, LIMIT + shoulder), ('velocity="3" effort="20"/>', f'velocity="3"/>{elbow}'))

    plain = '<mimic joint="shoulder"/>'
    rows = [
        ("plain", "warn", following(plain)),  # the follower's narrower limits bind its leader
        ("parent that comes later", "warn", following("", '<mimic joint="elbow" multiplier="2"/>')),
        ("factor and offset", "accept", following('<mimic joint="shoulder" multiplier="-0.3" offset="0.2"/>')),
        ("never within the limits", "warn", following('<mimic joint="shoulder" multiplier="0.1" offset="9"/>')),
        ("factor zero", "warn", following('<mimic joint="shoulder" multiplier="0"/>')),
        ("huge factor", "refuse:mimic-multiplier", following('<mimic joint="shoulder" multiplier="1e9"/>')),
        ("itself", "refuse:mimic-cycle", following('<mimic joint="elbow"/>')),
        ("each other", "refuse:mimic-cycle", following(plain, '<mimic joint="elbow"/>')),
        ("unknown joint", "refuse:mimic-unknown", following('<mimic joint="sholder"/>')),
        ("no joint named", "refuse:mimic-leader", following("<mimic/>")),
        ("two mimics", "refuse:element-twice", following(plain + plain)),
        ("fixed leader", "warn", following(plain, "", (SHOULDER, fixed))),
        ("fixed follower", "warn", following("", '<mimic joint="elbow"/>', (SHOULDER, fixed))),
        ("floating leader", "refuse:mimic-type", following(plain, "", (SHOULDER, fixed.replace("fixed", "floating")))),
        ("planar follower", "refuse:mimic-type", following("", plain.replace("shoulder", "elbow"), _planar())),
        (
            "continuous leader, half speed",
            "warn",
            following(plain.replace("/>", ' multiplier="0.5"/>'), "", _turning()),
        ),
        ("leader locked", "accept", following(plain), {"options": {"locked": ("shoulder",)}}),
        ("follower locked", "refuse:locked-follower", following(plain), {"options": {"locked": ("elbow",)}}),
        (
            "unknown leader, follower locked",
            "accept",
            following('<mimic joint="gone"/>'),
            {"options": {"locked": ("elbow",)}},
        ),
        ("mimic of mimic, backwards", "accept", mimic_chain((2, 1, 0))),
        ("mimic of mimic of fixed", "warn", mimic_chain((0, 1, 2)).replace(b"revolute", b"fixed", 1)),
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
