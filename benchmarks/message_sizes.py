"""Sizes of messages as an ASN.1 encoder writes them: what `tests/golden/message-sizes.json` holds.

It needs pycrate (pip install pycrate==0.8.1) and the modules of the standards,
which do not ship here:

- ETSI's, a directory of .asn files: `TS103900v231-CAM.asn`, `TS102894-2v241-CDD.asn` and the
  `CPM-*.asn` of `TS103324v211/`, from `asn1/release2` of github.com/riebl/vanetza (published by
  ETSI at forge.etsi.org);
- J2735 of September 2024, which has J3224's SDSM, as pycrate compiles it:
  `j2735_202409/__init__.py` of github.com/jwillmartin/j2735_2024.

The CAM of EN 302 637-2 and IEEE 1609.2 come with pycrate. Values are drawn within their ranges.

    python benchmarks/message_sizes.py ETSI_DIRECTORY J2735_MODULE > tests/golden/message-sizes.json
"""

import argparse
import importlib.util
import json
import random
import re
import tempfile
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

UNTESTED = "it needs pycrate and modules of the standards, which do not ship here"
# Containers of our own, of elements that CDD and J2735 have. They stand where an MCM or an MSCM
# would.
OWN = """
Own DEFINITIONS AUTOMATIC TAGS ::= BEGIN
IMPORTS ItsPduHeader, GenerationDeltaTime, ReferencePosition, StationId FROM ETSI-ITS-CDD
  {itu-t (0) identified-organization (4) etsi (0) itsDomain (5) wg1 (1) 102894 cdd (2) major-version-4 (4)
  minor-version-3 (3)};
Judgement ::= SEQUENCE { probabilities SEQUENCE (SIZE (0..255)) OF INTEGER (0..100),
  risk ENUMERATED {low, medium, high}, evidence UTF8String }
EtsiIntent ::= SEQUENCE { header ItsPduHeader, generationDeltaTime GenerationDeltaTime,
  referencePosition ReferencePosition, judgement Judgement, ... }
EtsiRequest ::= SEQUENCE { header ItsPduHeader, generationDeltaTime GenerationDeltaTime,
  referencePosition ReferencePosition, deadline INTEGER (0..4095),
  helpers SEQUENCE (SIZE (1..1024)) OF StationId, ... }
SaeFrame ::= SEQUENCE { messageId INTEGER (0..32767), value SaeValue, ... }
SaeValue ::= OCTET STRING
SaeStart ::= SEQUENCE { msgCnt INTEGER (0..127), sourceID OCTET STRING (SIZE (4)),
  secMark INTEGER (0..65535), lat INTEGER (-900000000..900000001), long INTEGER (-1799999999..1800000001) }
SaeIntent ::= SEQUENCE { start SaeStart, judgement Judgement, ... }
SaeRequest ::= SEQUENCE { start SaeStart, deadline INTEGER (0..4095),
  helpers SEQUENCE (SIZE (1..1024)) OF OCTET STRING (SIZE (4)), ... }
END
"""  # noqa: E501
OBJECTS, POINTS = (*range(21), 60, 255), (1, 2, 5, 10, 23)
ACTIONS, TEXTS, HELPERS = (0, 1, 3, 5, 15), (0, 1, 60, 119, 120, 200), (1, 3, 32)
PAYLOADS = (1, 40, 60, 115, 127, 128, 200, 255, 256, 300, 1400)


def number(least: int, most: int) -> int:
    """Draw a value of a range, its ends more often."""
    return random.choice((least, most, random.randint(least, most)))


def etsi_start(message_id: int) -> dict[str, Any]:
    return {"protocolVersion": 2, "messageId": message_id, "stationId": number(0, 2**32 - 1)}


def etsi_position(
    major: str = "semiMajorConfidence",
    minor: str = "semiMinorConfidence",
    turn: str = "semiMajorOrientation",
) -> dict[str, Any]:
    return {
        "latitude": number(-900000000, 900000001),
        "longitude": number(-1800000000, 1800000001),
        "positionConfidenceEllipse": {
            major: number(0, 4095),
            minor: number(0, 4095),
            turn: number(0, 3601),
        },
        "altitude": {"altitudeValue": number(-100000, 800001), "altitudeConfidence": "unavailable"},
    }


def cam(points: int) -> dict[str, Any]:
    """Return the members of a CAM; the low-frequency container with a path of some points, if
    any.
    """
    high = {
        "heading": {"headingValue": number(0, 3601), "headingConfidence": number(1, 127)},
        "speed": {"speedValue": number(0, 16383), "speedConfidence": number(1, 127)},
        "driveDirection": "forward",
        "vehicleLength": {
            "vehicleLengthValue": number(1, 1023),
            "vehicleLengthConfidenceIndication": "unavailable",
        },
        "vehicleWidth": number(1, 62),
        "longitudinalAcceleration": {"value": number(-160, 161), "confidence": number(0, 102)},
        "curvature": {"curvatureValue": number(-1023, 1023), "curvatureConfidence": "unavailable"},
        "curvatureCalculationMode": "yawRateUsed",
        "yawRate": {"yawRateValue": number(-32766, 32767), "yawRateConfidence": "unavailable"},
    }
    position = {
        "deltaLatitude": 1,
        "deltaLongitude": number(-131071, 131072),
        "deltaAltitude": 12800,
    }
    path = [{"pathPosition": position, "pathDeltaTime": number(1, 65535)} for _ in range(points)]
    low = {"vehicleRole": "default", "exteriorLights": (number(0, 255), 8), "pathHistory": path}
    names = "semiMajorAxisLength", "semiMinorAxisLength", "semiMajorAxisOrientation"
    parameters: dict[str, Any] = {
        "basicContainer": {"stationType": 5, "referencePosition": etsi_position(*names)},
        "highFrequencyContainer": ("basicVehicleContainerHighFrequency", high),
    }
    if points:
        parameters["lowFrequencyContainer"] = ("basicVehicleContainerLowFrequency", low)
    return {"generationDeltaTime": number(0, 65535), "camParameters": parameters}


def cam_of_release_1(points: int) -> dict[str, Any]:
    """Return the members of a CAM by the names of EN 302 637-2."""
    members = cam(points)
    parameters = members["camParameters"]
    high = parameters["highFrequencyContainer"][1]
    names = {
        "value": "longitudinalAccelerationValue",
        "confidence": "longitudinalAccelerationConfidence",
    }
    acceleration = {names[key]: value for key, value in high["longitudinalAcceleration"].items()}
    high["longitudinalAcceleration"] = acceleration
    parameters["basicContainer"]["referencePosition"] = etsi_position()
    return members


def cpm(objects: int, optional: bool) -> dict[str, Any]:
    def component() -> dict[str, int]:
        return {"value": number(-131072, 131071), "confidence": number(1, 4096)}

    def perceived() -> dict[str, Any]:
        members: dict[str, Any] = {
            "objectId": number(0, 65535),
            "measurementDeltaTime": number(-2048, 2047),
            "position": {"xCoordinate": component(), "yCoordinate": component()},
        }
        if optional:
            polar = {
                "velocityMagnitude": {
                    "speedValue": number(0, 16383),
                    "speedConfidence": number(1, 127),
                },
                "velocityDirection": {"value": number(0, 3601), "confidence": number(1, 127)},
            }
            members["velocity"] = "polarVelocity", polar
            kind = "vehicleSubClass", random.choice((0, 5, 7, 8, 14))
            members["classification"] = [{"objectClass": kind, "confidence": number(1, 101)}]
        return members

    listed = {
        "numberOfPerceivedObjects": objects,
        "perceivedObjects": [perceived() for _ in range(objects)],
    }
    angle = {"orientationAngle": {"value": number(0, 3601), "confidence": number(1, 127)}}
    own = "CPM-OriginatingStationContainers", "OriginatingVehicleContainer"
    theirs = "CPM-PerceivedObjectContainer", "PerceivedObjectContainer"
    return {
        "managementContainer": {
            "referenceTime": number(0, 4398046511103),
            "referencePosition": etsi_position(),
        },
        "cpmContainers": [
            {"containerId": 1, "containerData": (own, angle)},
            {"containerId": 5, "containerData": (theirs, listed)},
        ],
    }


def bsm(points: int) -> dict[str, Any]:
    """Return the members of a BSM; with a path of some points, if any, those of its part II."""
    core = {
        "msgCnt": number(0, 127),
        "id": random.randbytes(4),
        "secMark": number(0, 65535),
        "lat": number(-900000000, 900000001),
        "long": number(-1799999999, 1800000001),
        "elev": number(-4096, 61439),
        "accuracy": {"semiMajor": 5, "semiMinor": number(0, 255), "orientation": number(0, 65535)},
        "transmission": "forwardGears",
        "speed": number(0, 8191),
        "heading": number(0, 28800),
        "angle": number(-126, 127),
        "accelSet": {"long": number(-2000, 2001), "lat": 0, "vert": number(-127, 127), "yaw": 0},
        "brakes": {
            "wheelBrakes": (number(0, 31), 5),
            "traction": "on",
            "abs": "on",
            "scs": "on",
            "brakeBoost": "on",
            "auxBrakes": "on",
        },
        "size": {"width": number(0, 1023), "length": number(0, 4095)},
    }
    if not points:
        return {"coreData": core}
    crumbs = [
        {
            "latOffset": number(-131072, 131071),
            "lonOffset": 0,
            "elevationOffset": 5,
            "timeOffset": 9,
        }
        for _ in range(points)
    ]
    extensions = {
        "pathHistory": {"crumbData": crumbs},
        "pathPrediction": {"radiusOfCurve": number(-32767, 32767), "confidence": number(0, 200)},
    }
    kind = "Common", "VehicleSafetyExtensions"
    return {"coreData": core, "partII": [{"partII-Id": 0, "partII-Value": (kind, extensions)}]}


def sdsm(objects: int, optional: bool) -> dict[str, Any]:
    def detected() -> dict[str, Any]:
        common = {
            "objType": "vehicle",
            "objTypeCfd": number(0, 101),
            "objectID": number(0, 65535),
            "measurementTime": number(-1500, 1500),
            "timeConfidence": "unavailable",
            "pos": {"offsetX": number(-32767, 32767), "offsetY": number(-32767, 32767)},
            "posConfidence": {"pos": "unavailable", "elevation": "unavailable"},
            "speed": number(0, 8191),
            "speedConfidence": "unavailable",
            "heading": number(0, 28800),
            "headingConf": "unavailable",
        }
        lights = {"lights": (number(0, 511), 9), "vehicleClass": number(0, 255)}
        return {
            "detObjCommon": common,
            **({"detObjOptData": ("detVeh", lights)} if optional else {}),
        }

    return {
        "msgCnt": number(0, 127),
        "sourceID": random.randbytes(4),
        "equipmentType": "obu",
        "sDSMTimeStamp": {
            "year": 2026,
            "month": 11,
            "day": 27,
            "hour": 8,
            "minute": 30,
            "second": number(0, 65535),
        },
        "refPos": {"lat": number(-900000000, 900000001), "long": number(-1799999999, 1800000001)},
        "refPosXYConf": {"semiMajor": 255, "semiMinor": 255, "orientation": number(0, 65535)},
        "objects": [detected() for _ in range(objects)],
    }


def judgement(actions: int, text: int) -> dict[str, Any]:
    shares = [number(0, 100) for _ in range(actions)]
    return {"probabilities": shares, "risk": "high", "evidence": "x" * text}


def sae_start() -> dict[str, Any]:
    place = {"lat": number(-900000000, 900000001), "long": number(-1799999999, 1800000001)}
    return {"msgCnt": 7, "sourceID": random.randbytes(4), "secMark": number(0, 65535), **place}


def uper(kind: Any, value: Any) -> int:
    """Encode a message and return its bits without what fills the last octet."""
    kind.set_val(value)
    encoded = kind.to_uper_ws()
    bits = int(kind._to_per_ws().get_bl())
    assert len(encoded) == -(-bits // 8)
    kind.from_uper(encoded)
    assert kind.to_uper() == encoded
    return bits


def messages(etsi: Any, j2735: Any, own: Any) -> Iterator[tuple[str, dict[str, int], int]]:
    """Yield each message's name, counts and bits."""
    from pycrate_asn1dir import ITS_CAM_2

    sae = j2735.MessageFrame.MessageFrame
    cam_2, cam_1 = etsi.CAM_PDU_Descriptions.CAM, ITS_CAM_2.CAM_PDU_Descriptions.CAM
    for points in (0, *POINTS):
        bits = uper(cam_2, {"header": etsi_start(2), "cam": cam(points)})
        header = {"protocolVersion": 2, "messageID": 2, "stationID": number(0, 2**32 - 1)}
        assert bits == uper(cam_1, {"header": header, "cam": cam_of_release_1(points)}), points
        yield "CAM", {"points": points}, bits
        frame = ("BasicSafetyMessage", "BasicSafetyMessage"), bsm(points)
        yield "BSM", {"points": points}, uper(sae, {"messageId": 20, "value": frame})
    kind = etsi.CPM_PDU_Descriptions.CollectivePerceptionMessage
    for objects in OBJECTS:
        for optional in (False, True):
            counts = {"objects": objects, "optional": int(optional)}
            yield (
                "CPM",
                counts,
                uper(kind, {"header": etsi_start(14), "payload": cpm(objects, optional)}),
            )
            if objects:
                frame = (
                    ("SensorDataSharingMessage", "SensorDataSharingMessage"),
                    sdsm(objects, optional),
                )
                yield "SDSM", counts, uper(sae, {"messageId": 41, "value": frame})

    def framed(kind: Any, value: Any) -> int:
        kind.set_val(value)
        return uper(own.SaeFrame, {"messageId": 32767, "value": kind.to_uper()})

    def etsi_members() -> dict[str, Any]:
        start = {"header": etsi_start(20), "generationDeltaTime": number(0, 65535)}
        return {**start, "referencePosition": etsi_position()}

    for actions in ACTIONS:
        for text in TEXTS:
            counts, value = (
                {"actions": actions, "text_bytes": text},
                {"judgement": judgement(actions, text)},
            )
            yield "etsi-intent", counts, uper(own.EtsiIntent, {**etsi_members(), **value})
            yield "sae-intent", counts, framed(own.SaeIntent, {"start": sae_start(), **value})
    for helpers in HELPERS:
        counts = {"helpers": helpers}
        deadline: dict[str, Any] = {"deadline": number(0, 4095)}
        ids = [number(0, 2**32 - 1) for _ in range(helpers)]
        yield (
            "etsi-request",
            counts,
            uper(own.EtsiRequest, {**etsi_members(), **deadline, "helpers": ids}),
        )
        names = [random.randbytes(4) for _ in range(helpers)]
        asked = {"start": sae_start(), **deadline, "helpers": names}
        yield "sae-request", counts, framed(own.SaeRequest, asked)


def signed(psid: int, payload: int, certificate: bool) -> int:
    """Return the bits of a signed message: IEEE 1609.2, by the profile of TS 103 097 for a CAM."""
    from pycrate_asn1dir import ITS_IEEE1609_2

    data = ITS_IEEE1609_2.Ieee1609Dot2.Ieee1609Dot2Data
    curve = {"rSig": ("x-only", random.randbytes(32)), "sSig": random.randbytes(32)}
    signature = "ecdsaNistP256Signature", curve
    permissions = [
        {"psid": 36, "ssp": ("bitmapSsp", bytes(3))},
        {"psid": 639, "ssp": ("bitmapSsp", bytes(2))},
    ]
    key = "verificationKey", ("ecdsaNistP256", ("compressed-y-0", random.randbytes(32)))
    to_be_signed = {
        "id": ("none", 0),
        "cracaId": bytes(3),
        "crlSeries": 0,
        "validityPeriod": {"start": number(0, 2**32 - 1), "duration": ("hours", number(0, 65535))},
        "appPermissions": permissions,
        "verifyKeyIndicator": key,
    }
    ticket = {
        "version": 3,
        "type": "explicit",
        "issuer": ("sha256AndDigest", random.randbytes(8)),
        "toBeSigned": to_be_signed,
        "signature": signature,
    }
    unsecured = {"protocolVersion": 3, "content": ("unsecuredData", random.randbytes(payload))}
    header = {"psid": psid, "generationTime": number(0, 2**64 - 1)}
    content = {
        "hashId": "sha256",
        "tbsData": {"payload": {"data": unsecured}, "headerInfo": header},
        "signer": ("certificate", [ticket]) if certificate else ("digest", random.randbytes(8)),
        "signature": signature,
    }
    data.set_val({"protocolVersion": 3, "content": ("signedData", content)})
    return 8 * len(data.to_coer())


def compiled(texts: list[str]) -> Any:
    """Compile ASN.1 modules, without what pycrate cannot read and PER does not see.

    That is inner subtyping (X.691, 10.3.16), and what an extension adds to a size.
    """
    from pycrate_asn1c.asnproc import PycrateGenerator, compile_text, generate_modules

    def bare(text: str) -> str:
        text = re.sub(r"/\*.*?\*/|--[^\n]*", "", text, flags=re.DOTALL)
        text = re.sub(r"(\.\.\.) *, *\d+\.\.\d+ *\)", r"\1)", text)
        text = text.replace("SequenceOfCartesianPosition3d (SIZE", "SEQUENCE (SIZE").replace(
            "SEQUENCE (SIZE(3..16,...))", "SEQUENCE (SIZE(3..16,...)) OF CartesianPosition3d"
        )
        kept, place = "", 0
        while place < len(text):
            if re.match(r"\([(\s]*WITH COMPONENT", text[place:]):
                depth = 0
                while True:
                    depth += (text[place] == "(") - (text[place] == ")")
                    place += 1
                    if not depth:
                        break
                continue
            kept += text[place]
            place += 1
        return kept

    compile_text([bare(text) for text in texts])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "compiled.py"
        generate_modules(PycrateGenerator, str(path))
        return opened(path)


def opened(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("etsi", type=Path, help="directory of ETSI's .asn files")
    arguments.add_argument("j2735", type=Path, help="J2735 as a module of pycrate")
    given = arguments.parse_args()
    random.seed(0)
    paths = sorted(given.etsi.glob("*.asn"))
    etsi = compiled([*(path.read_text("latin-1") for path in paths), OWN])
    cases = [
        {"message": name, **counts, "bits": bits}
        for name, counts, bits in messages(etsi, opened(given.j2735), etsi.Own)
    ]
    envelopes = [
        {
            "psid": psid,
            "payload_bits": 8 * payload,
            "certificate": certificate,
            "bits": signed(psid, payload, certificate),
        }
        for psid in (32, 36, 144, 639)
        for payload in PAYLOADS
        for certificate in (False, True)
    ]
    made = {
        "command": "python benchmarks/message_sizes.py ETSI_DIRECTORY J2735_MODULE",
        "encoder": f"pycrate {version('pycrate')}",
        "modules": [path.name for path in paths] + ["J2735 2024-09"],
    }
    print(
        json.dumps(
            {**made, "messages": cases, "envelopes": envelopes}, indent=None, separators=(",", ":")
        )
    )


if __name__ == "__main__":
    main()
