"""The chain of plain bodies is the model that MuJoCo 3 compiles from its own composite."""

import mujoco
import numpy as np
import pytest

import cablejax.simulate.plant.model
from cablejax.cable import Discretisation
from cablejax.effects.given import parse_effect
from cablejax.simulate import composite
from cablejax.simulate.plant import PlantConfig, plant_model

# Links of an eighth of a metre: the composite keeps its vertices in single precision.
EXACT = {dimension: Discretisation(n_links=9, dimension=dimension, timestep=0.005) for dimension in (2, 3)}
# Names, and what the composite adds for viewers: sites at both ends, a text, another group of joints. It excludes
# contacts between neighbours, whose collision masks never meet.
OF_NO_ACCOUNT = (
    *("name", "nnames", "site", "nsite", "text", "ntext", "exclude", "nexclude", "jnt_group", "nbuffer", "signature"),
    "actuator_trnid",  # counts sites
)


def composite_links(spec, lengths, radius, *, dimension, **contact):
    """`add_links` by MuJoCo 3's `<composite>`."""
    vertices = " ".join(f"{s:.9g} 0 0" for s in [0.0, *np.cumsum(lengths)])
    cable = mujoco.MjSpec.from_string(f"""
    <mujoco><worldbody>
      <composite type="cable" prefix="" initial="free" vertex="{vertices}">
        <joint kind="main"/><geom type="capsule" size="{radius}"/>
      </composite>
    </worldbody></mujoco>""")
    spec.worldbody.add_frame().attach_body(cable.body("B_first"), "cable", "")
    links = [body for body in spec.bodies if body.name.startswith("cable")]
    for k, link in enumerate(links):
        for field, value in contact.items():
            setattr(link.geoms[0], field, value)
        if dimension == 2:
            spec.delete(link.joints[0])
            for axis in [] if k else [[1, 0, 0], [0, 1, 0]]:
                link.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
            link.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    return links


def fields(structure, prefix="") -> dict[str, np.ndarray]:
    """Every number and array of a model, or of its options."""
    names = (name for name in dir(structure) if not name.startswith(("_", *OF_NO_ACCOUNT)))
    values = {prefix + name: getattr(structure, name) for name in names}
    return {name: value for name, value in values.items() if isinstance(value, int | float | np.ndarray)}


def held(*effects: str) -> PlantConfig:
    return PlantConfig(discretisation=EXACT[3], effects=tuple(map(parse_effect, effects)))


@pytest.mark.skipif(mujoco.__version__ >= "4", reason="MuJoCo 4 has no <composite>")
@pytest.mark.parametrize(
    ("build", "config"),
    [
        (composite.build_chain, EXACT[2]),
        (composite.build_chain, EXACT[3]),
        (composite.build_grasped_chain, EXACT[2]),
        (composite.build_grasped_chain, EXACT[3]),
        (composite.build_grasped_chain, Discretisation()),
        (plant_model, held()),
        (plant_model, held("gripper_compliance:gripper=0,stiffness_n_m_per_rad=0.3", "axial_stretch:stiffness_n=20")),
    ],
    ids=["planar", "spatial", "planar-held", "spatial-held", "default", "plant", "compliant-plant"],
)
def test_every_array_of_the_model_is_the_composites(build, config, monkeypatch):
    own = build(config)
    monkeypatch.setattr(composite, "add_links", composite_links)
    monkeypatch.setattr(cablejax.simulate.plant.model, "add_links", composite_links)
    reference = build(config)
    actual, expected = ({**fields(model), **fields(model.opt, "opt.")} for model in (own, reference))
    assert reference.nexclude > 0 and own.nexclude == 0  # the reference is the composite
    assert len(expected) > 400 and actual.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(actual[name], value, err_msg=name)
    np.testing.assert_array_equal(
        own.site_bodyid[own.actuator_trnid[:, 0]], reference.site_bodyid[reference.actuator_trnid[:, 0]]
    )
