"""The support graph: objects with their shapes, and which supports which, how probably."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from caryatid.errors import GoalError, did_you_mean
from caryatid.geometry.shapes import Shape, Uncertainty
from caryatid.geometry.transforms import Array
from caryatid.runtime import Pictured
from caryatid.sensing.views import MAX_LABEL, SUPPORT_LABEL

if TYPE_CHECKING:
    import networkx as nx

Role = Literal["object", "support_surface"]
"""What a vertex is."""
Kind = Literal["bottom-up", "lean", "top-down"]
"""How a support holds: from below, from the side, or by weight from above."""
ChangeKind = Literal["removed", "moved", "added"]
"""What happens to objects."""
LIKELY = 0.5
"""Minimum probability of a support in a graph [1]."""
DOUBTFUL = 0.9
"""Probability up to which a support is doubtful [1]."""


@dataclass(frozen=True, eq=False, slots=True)
class SceneObject(Pictured):
    """A vertex of the support graph.

    Attributes:
        id: Its name: `o` + label for an object, `o0` for the main support surface, `s1`, … for the others.
        label: Its number in label images.
        shape: The fitted primitive, in the world frame. A support surface is a thin box.
        role: `object` or `support_surface`.
        occurrences: Number of views in which it was extracted.
        opportunities: Number of views in which it could have been extracted.
        residual: Mean absolute distance of its points to the shape [m].
        poor_fit: None of the three shapes explains its points within the configured error.
        seen: Which sides (-x, +x, -y, +y, -z, +z along the object's axes) points confirm.
        why: How the shape came about, for a person to read.
        uncertainty: Uncertainty of the shape, if known.
        doubt: What is physically implausible about it, for a person to read; empty if nothing is.
        probability: Probability that its true shape agrees with `shape` by an IoU of 0.5 [1], or None.
        name: What masks call it, such as `mug`, or None.
    """

    id: str
    label: int
    shape: Shape
    role: Role = "object"
    occurrences: int = 1
    opportunities: int = 1
    residual: float = 0.0
    poor_fit: bool = False
    seen: tuple[bool, bool, bool, bool, bool, bool] = (True,) * 6
    why: str = ""
    uncertainty: Uncertainty | None = None
    doubt: str = ""
    probability: float | None = None
    name: str | None = None

    @property
    def title(self) -> str:
        """Its name and id, such as `mug (o3)`; without a name its id."""
        return self.id if self.name is None else f"{self.name} ({self.id})"

    @property
    def centre_world(self) -> Array:
        """Centre (3,) [m] of the shape."""
        return self.shape.T_world_object[:3, 3]

    def __repr__(self) -> str:
        return f"SceneObject({self.id}: {self.shape})"


@dataclass(frozen=True, eq=False, slots=True)
class Support:
    """A directed edge: `supporter` holds up `supported`.

    Attributes:
        supporter: Id of the object that supports.
        supported: Id of the object that is supported.
        kind: `bottom-up` from below, `lean` from the side, `top-down` by weight from above.
        certain: Whether its probability is at least `LIKELY`; without one, whether it holds from below.
        occurrences: How many times it was extracted and matched: #occ(e) of eq. 2.
        opportunities: How many times both its ends were extracted.
        contact_world: Centre (3,) [m] of the contact patch, or None.
        normal_world: Normal (3,) of the separating plane, from supporter to supported, or None.
        why: The test that found it, with figures.
        probability: Probability that it exists [1], or None.
    """

    supporter: str
    supported: str
    kind: Kind = "bottom-up"
    certain: bool = True
    occurrences: int = 1
    opportunities: int = 1
    contact_world: Array | None = None
    normal_world: Array | None = None
    why: str = ""
    probability: float | None = None

    @property
    def pair(self) -> tuple[str, str]:
        """(supporter, supported)."""
        return self.supporter, self.supported

    @property
    def belief(self) -> float:
        """Its probability [1]; if unknown, 1 if it is certain and 0.5 if it is not."""
        if self.probability is None:
            return 1.0 if self.certain else 0.5
        return self.probability

    @property
    def doubtful(self) -> bool:
        """Whether its `belief` is at most `DOUBTFUL`."""
        return self.belief <= DOUBTFUL

    def __repr__(self) -> str:
        found = f"found in {self.occurrences} of {self.opportunities}"
        likely = f"probability {self.belief:.2f}"
        return f"Support({self.supporter} → {self.supported}, {self.kind}, {likely}, {found})"


@dataclass(frozen=True, eq=False, slots=True)
class SupportGraph(Pictured):
    """G_s = (V, E) of the paper, section III-A, in the order of the objects' labels.

    Attributes:
        objects: The vertices, the support surfaces first, the main one before the others.
        supports: The edges.
        stability: Per object id the support area ratio r_s of eq. 1 and the verdict of both tests.
    """

    objects: tuple[SceneObject, ...] = ()
    supports: tuple[Support, ...] = ()
    stability: dict[str, Stability] = field(default_factory=dict)

    def __getitem__(self, word: str) -> SceneObject:
        """The object with an id or a name."""
        object_id = self.find_id(word)
        for candidate in self.objects:
            if candidate.id == object_id:
                return candidate
        raise KeyError(f"unknown object '{word}'; {self.suggest_objects(word)}")

    def __contains__(self, object_id: object) -> bool:
        return any(o.id == object_id for o in self.objects)

    def __len__(self) -> int:
        return len(self.objects)

    def __iter__(self) -> Iterator[str]:
        return (o.id for o in self.objects)

    def find_id(self, word: str) -> str | None:
        """Return the id of the object with an id or a name; None if there is none.

        Raises:
            GoalError: Several objects have the name.
        """
        ids = [o.id for o in self.objects if o.name == word]
        if word in self:
            return word
        if len(ids) > 1:
            raise GoalError(word, "is the name of several objects", f"give the id: {', '.join(ids)}")
        return ids[0] if ids else None

    def suggest_objects(self, word: str) -> str:
        """Say what a word that is no object's id or name may mean, and list the objects, as a remedy."""
        meant = did_you_mean(word, [o.name for o in self.movable if o.name is not None])
        return f"{meant}known objects: {', '.join(o.title for o in self.movable) or 'none'}"

    @property
    def support_surface(self) -> SceneObject | None:
        """The main support surface, such as the table; None where none has been found."""
        return next(iter(self.support_surfaces), None)

    @property
    def support_surfaces(self) -> tuple[SceneObject, ...]:
        """All support surfaces, the main one first."""
        return tuple(o for o in self.objects if o.role == "support_surface")

    @property
    def movable(self) -> tuple[SceneObject, ...]:
        """All objects but the support surfaces."""
        return tuple(o for o in self.objects if o.role == "object")

    def support(self, supporter: str, supported: str) -> Support | None:
        """Return the edge between two ids, or None.

        Args:
            supporter: Id of the one that holds, such as `o1`.
            supported: Id of the one that is held.
        """
        return next((s for s in self.supports if s.pair == (supporter, supported)), None)

    def supporters(self, object_id: str) -> list[Support]:
        """Edges that end at `object_id`."""
        return [s for s in self.supports if s.supported == object_id]

    def to_networkx(self) -> nx.DiGraph:
        """Return a DiGraph, supporter → supported; nodes and edges carry `data`, the frozen objects here."""
        import networkx as nx

        graph = nx.DiGraph()
        for o in self.objects:
            graph.add_node(o.id, data=o, role=o.role, shape=o.shape.kind)
        for s in self.supports:
            known = {} if s.probability is None else {"probability": s.probability}
            graph.add_edge(s.supporter, s.supported, data=s, kind=s.kind, certain=s.certain, **known)
        return graph

    def __repr__(self) -> str:
        edges = [f"{s.supporter} → {s.supported}{'?' * s.doubtful}" for s in self.supports]
        told = edges if len(edges) <= 8 else [*edges[:7], "…"]
        counts = f"objects={len(self.movable)}, supports={len(edges)}"
        return f"SupportGraph({counts}{': ' if told else ''}{', '.join(told)})"


@dataclass(frozen=True, slots=True)
class Stability:
    """Stability of an object by its support polygon.

    Attributes:
        ratio: Support area ratio r_s in [0, 1], eq. 1.
        overhang: How far [m] the centre of mass projects outside the support polygon; negative inside,
            infinite where nothing supports it.
        small_area: Whether r_s is below r_s,min.
        tips: Whether `overhang` exceeds `support.overhang`; False if `support.stability` is `area`.
    """

    ratio: float
    overhang: float
    small_area: bool
    tips: bool

    @property
    def stable(self) -> bool:
        """Neither test fired."""
        return not (self.small_area or self.tips)


@dataclass(frozen=True, slots=True)
class Change:
    """What happened to an object between two views, or what the robot said it did.

    Attributes:
        kind: `removed`, `moved` to where `object_id` is now, or `added` where nothing was.
        object_id: Id of the object; one that was removed and is found again keeps it.
        view: Number of the view before which it happened, from 0.
        why: The evidence, with figures.
    """

    kind: ChangeKind
    object_id: str
    view: int
    why: str

    def __str__(self) -> str:
        return f"{self.object_id} was {self.kind}: {self.why}"


@dataclass(frozen=True, eq=False, slots=True)
class Grasp:
    """How a gripper takes hold of an object.

    Attributes:
        T_world_gripper: Pose (4, 4) at the grasp: z along the approach, x along the closing direction, turned
            about z by `gripper.turn`; origin between the fingertips or at the middle of the disc.
        width: Width of the object between the fingers [m]; 0 for suction.
        travel: Length of the straight path to it along z [m], with nothing in the way.
        seen_free: Share of the space around that path which was seen empty [1]; None if unknown.
    """

    T_world_gripper: Array
    width: float
    travel: float
    seen_free: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Entry `grasp` of a step in the output of `--json`."""
        known = {"T_world_gripper": self.T_world_gripper.tolist(), "width": self.width}
        return known | {"travel": self.travel, "seen_free": self.seen_free}


@dataclass(frozen=True, slots=True)
class TakeStep:
    """One object to remove.

    Attributes:
        object_id: Its id.
        hold: Ids of the objects that the other hand holds meanwhile.
        safe: The risk is no higher than `rehearsal.risk`.
        risk: Probability that another object moves, from the share of the rehearsals in which one did [1].
        why: The reason for the step, for a person to read.
        grasp: How the gripper takes hold of it; None without a gripper.
    """

    object_id: str
    hold: tuple[str, ...]
    safe: bool
    risk: float
    why: str
    grasp: Grasp | None = None

    def to_json(self) -> dict[str, Any]:
        """One entry of `steps` in the output of `--json`."""
        known = {"object": self.object_id, "hold": list(self.hold), "safe": self.safe, "risk": self.risk}
        grasp = {} if self.grasp is None else {"grasp": self.grasp.to_json()}
        return known | {"probability": 1.0 - self.risk, "why": self.why} | grasp


def object_id(label: int) -> str:
    """Id of the object or support surface with this label."""
    number = SUPPORT_LABEL - label
    return f"o{label}" if label <= MAX_LABEL else f"s{number}" if number else SUPPORT_SURFACE_ID


def label_of(object_id: str) -> int:
    """Label of the object or support surface with this id."""
    number = int(object_id[1:])
    return number if object_id[0] == "o" and number else SUPPORT_LABEL - number


def vertex_order(o: SceneObject) -> tuple[bool, int]:
    """Key that sorts vertices: the support surfaces first, the main one before the others, then by label."""
    surface = o.role == "support_surface"
    return not surface, -o.label if surface else o.label


SUPPORT_SURFACE_ID = "o0"
"""Id of the main support surface."""
