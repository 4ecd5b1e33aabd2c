"""3D scene of the page: the target, a dome with all views, the radar, and the image on its plane below."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from sarsplat.colours import LIGHT, PICKED, RADAR, Page, rgb
from sarsplat.geometry import ImageGrid, View
from sarsplat.viewer.subject import Cloud, Contributors

if TYPE_CHECKING:
    import viser

Polygon = Float[np.ndarray, "n 2"]
"""Corners of a convex polygon on the ground, m, in order."""

_RADAR, _LIT, _FAINT = rgb(RADAR), rgb(PICKED), rgb(LIGHT.muted)
_DOME = 1.9  # radius of the dome, in radii of the target
_REACH = 0.6  # extension of the line of one range above the target, in radii of the dome
_FIELD_DEG = 50.0  # vertical field of view
_CAMERA_ASIDE_DEG, _CAMERA_UP_DEG = 100.0, 27.0  # camera's azimuth from the first view, and elevation
_ROOM = 1.15  # half of the visible height, in radii of the dome
_PHONE, _BETWEEN_PANELS = 0.55, 0.62  # width over height of the free area: maximum on a phone, and on a small laptop
_THIN = 0.0015  # width of a line, in radii of the dome
_STEPS = 72  # segments of a circle of latitude
HIGHEST_DEG = 89.0
"""Highest grazing angle of a dragged radar, degrees."""

_LEAST_SHARE = 0.01  # minimum share of a pixel's power of a highlighted Gaussian


class Stage:
    """3D scene around the target's bounding box (corners, m).

    `views` are the known ones with their sets. `on_aim` gets the view of a dragged radar or a clicked dot, `on_plane`
    the ray of a click on the image's plane: origin and direction, m.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        box_m: tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]],
        views: list[tuple[View, str]],
        first: View,
        on_aim: Callable[[View], None],
        on_plane: Callable[[np.ndarray, np.ndarray], None],
    ) -> None:
        self._scene = scene = server.scene
        self.low, self.high = box_m
        self.centre = (self.low + self.high) / 2
        self.size_m = float(np.linalg.norm(self.high - self.low)) / 2
        self._radius = _DOME * self.size_m
        self._foot = np.array([*self.centre[:2], 0.0])
        self._on_plane = on_plane
        self._known = first
        self._aside = View((first.azimuth_deg - _CAMERA_ASIDE_DEG) % 360, _CAMERA_UP_DEG).direction
        server.initial_camera.position, server.initial_camera.look_at = self._camera(1.0)
        server.initial_camera.fov = np.radians(_FIELD_DEG)
        server.on_client_connect(self._fit)
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        scene.configure_default_lights(enabled=False)  # shading would change the colours
        scene.configure_environment_map(None, environment_intensity=0.0)
        scene.add_light_ambient("/light", intensity=np.pi)
        self._page: Page | None = None
        self._corners: Float[np.ndarray, "corners 3"] = np.empty((0, 3))  # of the visible image
        self._eye, _ = self._camera(1.0)
        self._grid(scene)
        self._dome(scene, views, on_aim)
        self._radar(scene, on_aim)
        self._plane: Any = None
        self._line = scene.add_line_segments("/pixel/line", np.zeros((1, 2, 3)), _LIT, thickness=0.02 * self._radius)
        self._lit = scene.add_point_cloud(
            "/pixel/lit",
            np.zeros((1, 3)),
            _LIT,
            point_size=0.03 * self._radius,
            point_shape="circle",
            precision="float32",
        )
        self._line.visible = self._lit.visible = False
        self._cloud: Any = None

    def _camera(self, aspect: float) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Position and aim of a camera that sees the dome in a window of this aspect (width over height).

        On a phone the controls cover the lower part of the window.
        """
        distance = _ROOM * self._radius / np.tan(np.radians(_FIELD_DEG / 2)) / min(aspect, _BETWEEN_PANELS)
        down = 0.25 if aspect > _PHONE else -0.3 * _ROOM / aspect
        return self._foot + distance * self._aside, self._foot + np.array([0, 0, down * self._radius])

    def _fit(self, client: "viser.ClientHandle") -> None:
        client.camera.position, client.camera.look_at = self._camera(client.camera.aspect)

        @client.camera.on_update
        def moved(camera: "viser.CameraHandle") -> None:  # the last one counts if several browsers are open
            self._eye = np.array(camera.position)
            self._redraw_ground()

    def _redraw_ground(self) -> None:
        """Draw the ground's lines, cut where they would cross the image below."""
        hidden = seen_through(self._corners, self._eye)
        self.grid.points = ground_lines(self._foot, self._radius, self._step_m, hidden).astype(np.float32)

    def paint(self, page: Page) -> None:
        """Colour the scene like the page."""
        if page is not self._page:
            self._page = page
            self.grid.colors = np.array(rgb(page.line), np.uint8)
            self._scene.set_background_image(np.full((2, 2, 3), rgb(page.ground), np.uint8), format="png")
            for name, dots in self._dots.items():
                dots.batched_colors = np.array(_linear(page.train if name == "train" else page.test), np.uint8)

    def _grid(self, scene: Any) -> None:
        self._step_m = float(10 ** np.floor(np.log10(self.size_m)))  # 1 m for a vehicle, 10 m for a ship
        self.grid = scene.add_line_segments("/ground", np.zeros((1, 2, 3)), _FAINT, thickness=_THIN * self._radius)
        self._redraw_ground()
        nose = self._foot + np.array([self._radius, 0, 0])
        self._nose = scene.add_label("/nose", f"nose (+x); squares: {self._step_m:g} m", position=nose)

    def _dome(self, scene: Any, views: list[tuple[View, str]], on_aim: Callable[[View], None]) -> None:
        turns = np.linspace(0, 2 * np.pi, _STEPS + 1)
        segments = []
        highest = max(view.grazing_deg for view, _ in views)
        for grazing in (ring for ring in (0.0, 30.0, 60.0) if ring == 0 or ring < highest):
            c, s = np.cos(np.radians(grazing)), np.sin(np.radians(grazing))
            ring = self._foot + self._radius * np.column_stack(
                [c * np.cos(turns), c * np.sin(turns), np.full_like(turns, s)]
            )
            segments.append(np.stack([ring[:-1], ring[1:]], axis=1))
        self._rings = scene.add_line_segments(
            "/dome/rings", np.concatenate(segments), _FAINT, thickness=_THIN * self._radius
        )
        import trimesh

        ball = trimesh.creation.icosphere(subdivisions=1)
        self._dots: dict[str, Any] = {}
        for name in ("train", "test"):
            chosen = [view for view, split in views if (split == "train") == (name == "train")]
            if not chosen:
                continue
            places = np.stack([self._at(view) for view in chosen])
            size = 0.02 * self._radius * min(1.0, (120 / len(views)) ** 0.5)
            dots = scene.add_batched_meshes_simple(
                f"/dome/{name}",
                ball.vertices,
                ball.faces,
                np.tile([1.0, 0, 0, 0], (len(chosen), 1)),
                places,
                batched_scales=np.full(len(chosen), size),
                cast_shadow=False,
                receive_shadow=False,
            )

            @dots.on_click
            def clicked(event: Any, chosen: list[View] = chosen) -> None:
                if event.instance_index is not None:
                    on_aim(chosen[event.instance_index])

            self._dots[name] = dots

    def _radar(self, scene: Any, on_aim: Callable[[View], None]) -> None:
        r = self._radius
        self._arrow = scene.add_arrows(
            "/radar/line",
            np.zeros((1, 2, 3)),
            _linear(RADAR),
            shaft_radius=0.008 * r,
            head_radius=0.022 * r,
            head_length=0.06 * r,
        )
        self._handle = scene.add_icosphere("/radar/handle", 0.05 * r, _RADAR, cast_shadow=False, receive_shadow=False)
        self._label = scene.add_label("/radar/label", "radar")

        @self._handle.on_drag
        async def dragged(event: Any) -> None:
            on_aim(self.view_under(np.array(event.client.camera.position), np.array(event.end_position)))

    def _at(self, view: View) -> Float[np.ndarray, " 3"]:
        return self._foot + self._radius * view.direction

    def view_under(self, camera: Float[np.ndarray, " 3"], pointer: Float[np.ndarray, " 3"]) -> View:
        """View at the dome's point under the mouse, on the near side; beside the dome, at the point nearest the ray."""
        ray = (pointer - camera) / np.linalg.norm(pointer - camera)
        origin = camera - self._foot
        half = float(origin @ ray)
        root = half**2 - float(origin @ origin) + self._radius**2
        place = origin + (-half - np.sqrt(max(root, 0.0))) * ray
        flat = float(np.hypot(place[0], place[1]))
        grazing = np.degrees(np.arctan2(place[2], flat))
        azimuth = float(np.degrees(np.arctan2(-place[1], place[0]))) % 360.0
        grazing = float(np.clip(grazing, lowest_deg(self._known), HIGHEST_DEG))
        return replace(self._known, azimuth_deg=azimuth, grazing_deg=grazing)  # keeps the tilt

    # ---- changes -----------------------------------------------------------------------------------------------------
    def aim(self, view: View) -> None:
        """Move the radar to a view, whose tilt and side it keeps when dragged."""
        self._known = view
        place = self._at(view)
        self._handle.position = place
        self._arrow.points = np.stack([place, self._foot + 0.45 * (place - self._foot)])[None].astype(np.float32)
        self._label.position = place + np.array([0, 0, 0.1 * self._radius])

    def show_dome(self, visible: bool) -> None:
        """Show or hide the views and the lines between them."""
        for node in (self._rings, *self._dots.values()):
            node.visible = visible

    def show_ground(self, visible: bool) -> None:
        """Show or hide the lines on the ground."""
        self.grid.visible = self._nose.visible = visible

    def draw_cloud(self, cloud: Cloud, colours: UInt8[np.ndarray, "n 3"], scale: float) -> None:
        """Show one cloud; if it is already shown, send only its colours and size."""
        size = cloud.size_m * scale
        if self._cloud is not None and self._cloud[0] is cloud:
            handle = self._cloud[1]
            if not np.array_equal(handle.colors, colours):
                handle.colors = colours
            if handle.point_size != size:
                handle.point_size = size
            return
        handle = self._scene.add_point_cloud(
            "/target", cloud.places_m, colours, point_size=size, point_shape="circle", precision="float32"
        )
        self._cloud = (cloud, handle)

    def plane_depth(self, view: View) -> float:
        """Elevation y_r of the image's plane, below all of the target, m."""
        return self._elevations(view)[0] - 0.12 * self._radius

    def _elevations(self, view: View) -> tuple[float, float]:
        """Lowest and highest elevation y_r of the target's box, m."""
        corners = np.array(list(product(*zip(self.low, self.high, strict=True))))
        elevations = corners @ view.look.frame[1]
        return float(elevations.min()), float(elevations.max())

    def iso_range_line(self, view: View, place_m: tuple[float, float]) -> Float[np.ndarray, "2 3"]:
        """Line of one azimuth and slant range, from the image's plane to well above the target, m."""
        azimuth, away = view.look.in_frame(*place_m)
        ends = self.plane_depth(view), self._elevations(view)[1] + _REACH * self._radius
        return np.array([[azimuth, elevation, away] for elevation in ends]) @ view.look.frame

    def lay_image(self, rgb: UInt8[np.ndarray, "rows columns 3"], view: View, part: ImageGrid, visible: bool) -> None:
        """Show an image on its plane, azimuth × slant range, perpendicular to the lines of one range."""
        frame, (wider, longer) = view.look.frame, view.look.in_frame(1.0, 1.0)
        place = np.array([wider * part.center_m[0], self.plane_depth(view), longer * part.center_m[1]]) @ frame
        across = frame[0]
        if view.side == "left":  # its frame is mirrored, but planes can only be rotated
            rgb, across = rgb[:, ::-1], -across
        turn = Rotation.from_matrix(np.stack([across, frame[2], -frame[1]], axis=1)).as_quat(scalar_first=True)
        size = wider * part.columns * part.spacing_m[0], longer * part.rows * part.spacing_m[1]
        if self._plane is not None and self._plane[1] == size:
            plane = self._plane[0]
            plane.image, plane.position, plane.wxyz = rgb, place, turn
        else:
            plane = self._scene.add_image(
                "/image", rgb, *size, format="png", cast_shadow=False, receive_shadow=False, wxyz=turn, position=place
            )

            @plane.on_click
            def clicked(event: Any) -> None:
                self._on_plane(np.array(event.ray_origin), np.array(event.ray_direction))

            self._plane = (plane, size)
        plane.visible = visible
        across, down = size[0] / 2 * frame[0], size[1] / 2 * frame[2]
        corners = place + np.stack([-across - down, across - down, across + down, down - across])
        self._corners = corners if visible else corners[:0]
        self._redraw_ground()

    def light(self, line: Float[np.ndarray, "2 3"] | None, lit: Contributors | None) -> None:
        """Highlight the line of one azimuth and range, and the contributors on it."""
        self._line.visible = line is not None
        self._lit.visible = lit is not None and len(lit.shares) > 0
        if line is not None:
            self._line.points = line[None].astype(np.float32)
        if lit is not None and len(lit.shares):
            shown = lit.shares >= min(_LEAST_SHARE, lit.shares[0])
            self._lit.points = lit.places_m[shown].astype(np.float32)
            self._lit.colors = np.tile(np.array(_LIT, np.uint8), (int(shown.sum()), 1))


def lowest_deg(view: View) -> float:
    """Lowest grazing angle of a dragged radar, degrees."""
    return -HIGHEST_DEG if view.aloft else 1.0


def _linear(colour: str) -> tuple[int, int, int]:
    """Linear RGB of a colour, for viser's instances, which are not decoded from sRGB."""
    red, green, blue = (round(255 * (value / 255) ** 2.2) for value in rgb(colour))
    return red, green, blue


# ---- lines on the ground, clipped where they would cross the SAR image below -----------------------------------------
def ground_lines(
    middle: Float[np.ndarray, " 3"], reach_m: float, step_m: float, hidden: Polygon
) -> Float[np.ndarray, "s 2 3"]:
    """Segments of a square grid up to `reach_m` from its middle, m, outside of the polygon `hidden`."""
    count = int(reach_m // step_m)
    segments = []
    for along in (0, 1):
        for offset in step_m * np.arange(-count, count + 1):
            place = float(middle[1 - along] + offset)
            first, last = float(middle[along] - reach_m), float(middle[along] + reach_m)
            leaves, returns = _crossed(hidden, 1 - along, place) or (last, last)
            for start, end in ((first, min(leaves, last)), (max(returns, first), last)):
                if start < end:
                    ends = np.empty((2, 3))
                    ends[:, along], ends[:, 1 - along], ends[:, 2] = (start, end), place, middle[2]
                    segments.append(ends)
    return np.stack(segments)


def seen_through(corners: Float[np.ndarray, "corners 3"], eye: Float[np.ndarray, " 3"]) -> Polygon:
    """Polygon of the ground, z = 0, through which a flat picture is seen from `eye`, m.

    Empty for a picture without corners or on the eye's side of the ground.
    """
    side = 1.0 if eye[2] >= 0 else -1.0
    heights = side * corners[:, 2]
    places = []
    for a, b, high, next_high in zip(corners, np.roll(corners, -1, axis=0), heights, np.roll(heights, -1), strict=True):
        if high <= 0:
            places.append(a)
        if (high < 0) != (next_high < 0):  # the edge crosses the ground
            places.append(a + high / (high - next_high) * (b - a))
    if not places or eye[2] == 0:
        return np.empty((0, 2))
    beyond = np.stack(places)
    share = eye[2] / (eye[2] - beyond[:, 2])
    projected: Polygon = (eye + share[:, None] * (beyond - eye))[:, :2]
    return projected


def _crossed(polygon: Polygon, axis: int, place: float) -> tuple[float, float] | None:
    """Interval of a line inside a convex polygon; the line has coordinate `place` on `axis`, along the other axis."""
    ends = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if (a[axis] < place) != (b[axis] < place):
            share = (place - a[axis]) / (b[axis] - a[axis])
            ends.append(float(a[1 - axis] + share * (b[1 - axis] - a[1 - axis])))
    return (min(ends), max(ends)) if ends else None
