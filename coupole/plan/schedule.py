"""Expands a plan into ordered views and their bursts. It uses no device and no file."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import assert_never

from coupole.geometry import Transform, look_at
from coupole.plan.bursts import FASTEST, Burst, DeviceTimes, Pace, burst_timing, bursts_of_exposure, with_sentinels
from coupole.plan.choices import Choice, OpenView, bound_of, bound_of_lights, has_enough
from coupole.plan.exposures import AutoExposure
from coupole.plan.led_table import LedTable
from coupole.plan.light_selection import first_lights, lit_in_bursts, sentinels_among
from coupole.plan.marks import MARKS, Marks
from coupole.plan.plan import AdaptiveViews, Grid, Joints, LookAt, Plan, View
from coupole.plan.plan_lights import AdaptiveLights, Lights
from coupole.plan.shot_id import MAX_CHARACTERS, Led, Panel, PanelMark, Sentinel, ShotId, ShotLabel
from coupole.plan.watch import SENTINELS

MOST_VIEWS, MOST_FRAMES = 2000, 5_000_000
"""Largest numbers of views and frames of one plan. This number of frames fits into memory."""
MOST_CANDIDATES = 400
"""Largest number of views among which a run chooses."""
TAKEN_TWICE = 4
"""Each fourth light of a first pass is taken twice, because noise is measured from pairs."""


@dataclass(frozen=True)
class ViewPose:
    """One view: a camera pose, or joint angles."""

    name: str
    support_from_camera: Transform | None
    joints_deg: tuple[float, ...] | None
    target_mm: tuple[float, float, float] | None


@dataclass(frozen=True)
class Schedule:
    """All views and bursts of a plan, in order."""

    views: tuple[ViewPose, ...]
    bursts: tuple[tuple[Burst, ...], ...]
    """Bursts of each view. If they are chosen in the run, this is the view's bound (`coupole.plan.choices`)."""
    labels: tuple[tuple[ShotLabel, ...], ...]
    """Labels of all frames that each view can have, in the order of its bursts. Frames that were left out are
    included."""
    choosable: tuple[tuple[Burst, ...], ...] = ()
    """Bursts from which the bursts of each view are chosen in the run; empty if the plan gives all bursts."""
    burst_sizes: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Number of LEDs of the bursts in a view's bound, by the view's name, for views whose LEDs are chosen."""
    most_views: int | None = None
    """Greatest number of the views that are taken, if views are chosen in the run; None if all are taken."""

    @property
    def view_count(self) -> int:
        """Greatest number of views that are taken."""
        return len(self.views) if self.most_views is None else min(self.most_views, len(self.views))

    @property
    def shots(self) -> int:
        """Number of frames under a light, without darks and marks; the greatest one if views are chosen."""
        return self.most_of([sum(int(b.is_light().sum()) for b in bursts) for bursts in self.bursts])

    @property
    def frames(self) -> int:
        """Number of frames; the greatest one if views are chosen."""
        return self.most_of([sum(len(b.labels) for b in bursts) for bursts in self.bursts])

    def most_of(self, figure_of_views: Sequence[int]) -> int:
        """Return the sum of a figure of each view. If views are chosen, it is the greatest possible sum."""
        return sum(sorted(figure_of_views, reverse=True)[: self.view_count])

    @property
    def is_open(self) -> bool:
        """True if bursts are chosen in the run."""
        return bool(self.choosable)

    def open_view(self, number: int) -> OpenView:
        """Return one of the views, if bursts are chosen."""
        view = self.views[number]
        return OpenView(view.name, view.target_mm, self.choosable[number], self.bursts[number])

    def planned_bursts(self) -> tuple[tuple[Burst, ...], ...]:
        """Bursts of each view, with every frame that the plan allows."""
        return self.choosable or self.bursts

    def without(self, hidden_leds: Mapping[str, Collection[int]]) -> Schedule:
        """Return the same schedule without some LEDs in some views (LED ids by name of view)."""

        def without_hidden(bursts_of_views: tuple[tuple[Burst, ...], ...]) -> tuple[tuple[Burst, ...], ...]:
            return tuple(
                tuple(b.without(hidden_leds[view.name]) for b in bursts) if hidden_leds.get(view.name) else bursts
                for view, bursts in zip(self.views, bursts_of_views, strict=True)
            )

        choosable = without_hidden(self.choosable) if self.choosable else ()
        without = replace(self, bursts=without_hidden(self.bursts), choosable=choosable)
        return without.with_bounds_of_lights() if self.burst_sizes else without

    def with_bounds_of_lights(self) -> Schedule:
        """Return the same schedule with new bounds of the views whose LEDs are chosen. The bounds use the LEDs
        that these views may have."""
        bounds: dict[tuple[int, tuple[int, ...]], tuple[Burst, ...]] = {}
        bursts_of_views = []
        for view, (whole, *_), bursts in zip(self.views, self.choosable, self.bursts, strict=True):
            sizes = self.burst_sizes.get(view.name)
            if sizes is None:
                bursts_of_views.append(bursts)
                continue
            key = id(whole.table), sizes  # views with the same LEDs share tables
            bounds[key] = bounds.get(key) or bound_of_lights(whole, sizes)
            bursts_of_views.append(tuple(replace(burst, view=view.name) for burst in bounds[key]))
        return replace(self, bursts=tuple(bursts_of_views))

    def with_choices(self, choices: Mapping[str, Sequence[Choice]]) -> Schedule:
        """Return the same schedule with the chosen bursts of views (by name) in place of their bounds, if enough
        are chosen. Raises KeyError for a choice that the plan does not allow."""
        bursts = []
        for number, (view, bound) in enumerate(zip(self.views, self.bursts, strict=True)):
            view_choices = choices.get(view.name, ())
            view_bursts = chosen_bursts(self.open_view(number), view_choices)
            bursts.append(view_bursts if has_enough(view_choices) else bound)
        return replace(self, bursts=tuple(bursts))

    def without_proven(self, proven: Collection[ShotId]) -> Schedule:
        """Return the schedule of the frames that are still to be taken: views with unproven frames, whose bursts
        contain only these."""
        remaining_bursts = [bursts_left(bursts, proven) for bursts in self.bursts]
        numbers = [n for n, bursts in enumerate(remaining_bursts) if bursts]
        taken_count = len(self.views) - len(numbers)
        most_views = None if self.most_views is None else max(0, self.most_views - taken_count)
        of_views = self._some(numbers, most_views)
        return replace(of_views, bursts=tuple(tuple(remaining_bursts[n]) for n in numbers))

    def only_views(self, names: Collection[str]) -> Schedule:
        """Return the schedule of these views alone, all of which are taken."""
        return self._some([n for n, view in enumerate(self.views) if view.name in names], None)

    def _some(self, numbers: Sequence[int], most_views: int | None) -> Schedule:
        return replace(
            self,
            views=tuple(self.views[n] for n in numbers),
            bursts=tuple(self.bursts[n] for n in numbers),
            labels=tuple(self.labels[n] for n in numbers),
            choosable=tuple(self.choosable[n] for n in numbers if self.choosable),
            most_views=most_views,
        )


def chosen_bursts(view: OpenView, choices: Sequence[Choice]) -> tuple[Burst, ...]:
    """Return all bursts of these choices. Raises KeyError for a burst that the plan does not allow."""
    return tuple(view.burst_of(burst) for choice in choices for burst in choice.bursts)


def bursts_left(bursts: Sequence[Burst], proven: Collection[ShotId]) -> list[Burst]:
    """Return the bursts with unproven frames. Each burst contains only these frames."""
    remaining_bursts = []
    for burst in bursts:
        missing_labels = {shot.label for shot in burst.shots if shot and shot not in proven}
        if missing_labels:
            remaining_bursts.append(
                burst if len(missing_labels) == len(burst.labels) else burst.only(missing_labels)
            )
    return remaining_bursts


def views_of_grid(grid: Grid) -> list[LookAt]:
    """Return each of its views, with its name. The length of the names is checked elsewhere."""
    grid_keys = {
        key: getattr(grid, key) for key in grid.model_fields_set & LookAt.model_fields.keys() - {"kind", "name"}
    }
    return [
        LookAt.model_construct(
            kind="look_at",
            name=f"{grid.name}-az{azimuth:g}-el{elevation:g}",
            azimuth_deg=azimuth,
            elevation_deg=elevation,
            **grid_keys,
        )
        for elevation in grid.elevations_deg
        for azimuth in grid.azimuths_deg
    ]


def expand_view(view: View) -> list[ViewPose]:
    """Return the poses of one entry of a plan's views; a grid has many poses."""
    match view:
        case LookAt():
            pose = look_at(view.target_mm, view.distance_mm, view.azimuth_deg, view.elevation_deg, view.roll_deg)
            return [ViewPose(view.name, pose, None, view.target_mm)]
        case Grid():
            return [pose for grid_view in views_of_grid(view) for pose in expand_view(grid_view)]
        case Joints():
            return [ViewPose(view.name, None, view.joints_deg, None)]
        case _:
            assert_never(view)


def build_schedule(
    plan: Plan,
    leds: LedTable,
    base_from_support: Transform,
    times: DeviceTimes,
    *,
    pace: Pace = FASTEST,
    runs_tables: bool = True,
) -> Schedule:
    """Return all bursts of all views. Views share tables, so that these need not be uploaded again.

    If a box does not run tables, it has no log. Then only marks can show that its lights went off.
    """
    bursts_of: dict[Lights, list[Burst]] = {}
    views: list[ViewPose] = []
    bursts: list[list[Burst]] = []
    hardware = plan.trigger == "hardware"
    marks: Marks = "coded" if hardware else "none" if runs_tables else "plain"
    is_auto = isinstance(plan.exposure, AutoExposure)
    for view in plan.view_entries:
        lights = view.lights or plan.lights
        if lights not in bursts_of:
            lit = _with_sentinels(lit_in_bursts(lights, leds, base_from_support), plan, leds)
            bursts_of[lights] = [
                burst
                for repeat in range(2 if is_auto else plan.repeats)
                for index, exposure_us in enumerate(plan.exposure.exposures_us)
                for burst in bursts_of_exposure(
                    lit,
                    burst_timing(exposure_us, times, hardware=hardware, pace=pace),
                    index,
                    repeat,
                    darks=plan.darks_per_view if repeat == 0 else 0,
                    marks=marks,
                )
            ]
        for pose in expand_view(view):
            views.append(pose)
            bursts.append([replace(burst, view=pose.name) for burst in bursts_of[lights]])
    labels = tuple(
        tuple(label for burst in view_bursts for label in burst.labels if label) for view_bursts in bursts
    )
    most_views = plan.views.until.views if isinstance(plan.views, AdaptiveViews) else None
    schedule = Schedule(tuple(views), tuple(map(tuple, bursts)), labels, most_views=most_views)
    if isinstance(plan.exposure, AutoExposure):
        return _with_open_exposures(schedule, plan.exposure, leds)
    return _with_open_lights(schedule, plan) if plan.chooses_lights else schedule


def _with_sentinels(
    lit: Sequence[Sequence[Led] | Panel], plan: Plan, leds: LedTable
) -> list[Sequence[Led | Sentinel] | Panel]:
    """Return the lights of each burst of one exposure, with sentinels if the plan has them."""
    sentinels = sentinels_among(lit, leds) if plan.takes_sentinels else ()
    return [
        lights if isinstance(lights, Panel) else with_sentinels(lights, sentinels, plan.watching.every)
        for lights in lit
    ]


def _with_open_lights(schedule: Schedule, plan: Plan) -> Schedule:
    """Return the schedule of a plan that chooses the LEDs of some of its views in the run."""
    burst_sizes = {
        pose.name: lights.burst_sizes
        for view in plan.view_entries
        if isinstance(lights := view.lights or plan.lights, AdaptiveLights)
        for pose in expand_view(view)
    }
    return replace(schedule, choosable=schedule.bursts, burst_sizes=burst_sizes).with_bounds_of_lights()


def _with_open_exposures(schedule: Schedule, exposure: AutoExposure, leds: LedTable) -> Schedule:
    """Return the schedule of a plan that chooses its exposures in the run: all bursts that may be chosen, and
    their bound."""
    bounds: dict[int, tuple[Burst, ...]] = {}
    for bursts in schedule.bursts:
        first_table = id(bursts[0].table)  # views with the same lights share tables
        if first_table not in bounds:
            lit = OpenView("", None, bursts, ()).leds
            taken_twice = first_lights(lit, leds, exposure.first_lights)[::TAKEN_TWICE]
            bounds[first_table] = bound_of(bursts, exposure.most_exposures, taken_twice.tolist())
    of_views = tuple(
        tuple(replace(burst, view=view.name) for burst in bounds[id(bursts[0].table)])
        for view, bursts in zip(schedule.views, schedule.bursts, strict=True)
    )
    return replace(schedule, bursts=of_views, choosable=schedule.bursts)


def too_large(plan: Plan, leds: LedTable) -> list[tuple[tuple[str | int, ...], str]]:
    """Return key path and message if a plan has more views or frames than can be planned."""
    sizes = [
        len(view.azimuths_deg) * len(view.elevations_deg) if isinstance(view, Grid) else 1
        for view in plan.view_entries
    ]
    if sum(sizes) > MOST_VIEWS:
        return [(("views",), f"expected at most {MOST_VIEWS} views in one plan, found {sum(sizes)}; split it")]
    view_count = sum(sizes)
    if isinstance(plan.views, AdaptiveViews):
        if view_count > MOST_CANDIDATES:
            return [(plan.views_key, f"expected at most {MOST_CANDIDATES} candidates, found {view_count}")]
        view_count = min(view_count, plan.views.until.views)
    exposures = plan.repeats * plan.exposure.frames_of_light
    frames = view_count * (exposures * len(leds.ids) + plan.darks_per_view)
    if frames > MOST_FRAMES:
        message = f"expected at most {MOST_FRAMES} frames in one plan, found up to {frames}; split it"
        return [(("repeats",) if plan.repeats > 1 else ("views",), message)]
    return []


def names_too_long(plan: Plan, leds: LedTable) -> list[tuple[tuple[str | int, ...], str]]:
    """Return key path and message for each view whose name makes shot ids too long for the frame table."""
    longest_light = max(int(leds.ids.max()), 9999)
    longest = ShotLabel(Led(longest_light), len(plan.exposure.exposures_us) - 1, plan.repeats - 1)
    mark = ShotLabel(PanelMark(4, MARKS - 1), longest.exposure, longest.repeat)
    labels = [longest, mark]
    if plan.takes_sentinels:
        last = Sentinel(longest_light, len(leds.ids) // plan.watching.every + 2 * SENTINELS)
        labels.append(ShotLabel(last, longest.exposure, longest.repeat))
    room = MAX_CHARACTERS - 1 - max(len(str(label)) for label in labels)
    return [
        (
            (*plan.views_key, number, "name"),
            f"{name}: a view's name may have {room} characters here, found {len(name)}",
        )
        for number, view in enumerate(plan.view_entries)
        if len(name := max((pose.name for pose in expand_view(view)), key=len)) > room
    ]
