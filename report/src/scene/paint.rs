//! Shaded shapes, drawn from far to near.

use tandem_core::scene::{Capsule, Cuboid};

use super::View;
use super::camera::{Camera, Projected, Vec3, difference, rotated, scaled, sum};
use super::color::{LIGHT, Rgb, brightness};

const FONT: &str = "-apple-system, 'Segoe UI', Helvetica, Arial, sans-serif";
/// Number of corners of a circle that is drawn as a polygon.
const N_CORNERS: u32 = 48;

/// Collects shapes with their depth and draws them from far to near.
pub(super) struct Painter {
    camera: Camera,
    table_z_m: f64,
    definitions: String,
    n_gradients: usize,
    ground: String,
    shadows: String,
    shapes: Vec<(f64, String)>,
}

impl Painter {
    pub(super) const fn new(camera: Camera, table_z_m: f64) -> Self {
        Self {
            camera,
            table_z_m,
            definitions: String::new(),
            n_gradients: 0,
            ground: String::new(),
            shadows: String::new(),
            shapes: Vec::new(),
        }
    }

    /// Adds the table, below everything else.
    pub(super) fn table(&mut self, table: &Cuboid, color: Rgb) {
        for (corners, normal) in faces(table) {
            if normal[2] > 0.5 {
                let outline = self.outline(&corners);
                self.definitions
                    .push_str(&format!(r#"<clipPath id="top"><path d="{outline}"/></clipPath>"#));
            }
            if self.camera.sees(corners[0], normal) {
                let outline = self.outline(&corners);
                let fill = color.lit(brightness(normal)).hex();
                self.ground.push_str(&format!(
                    r#"<path d="{outline}" fill="{fill}" stroke="{fill}" stroke-linejoin="round"/>"#
                ));
            }
        }
    }

    /// Adds a box with flat shading.
    pub(super) fn cuboid(&mut self, cuboid: &Cuboid, color: Rgb) {
        let mut drawn = String::new();
        for (corners, normal) in faces(cuboid) {
            if self.camera.sees(corners[0], normal) {
                let fill = color.lit(brightness(normal)).hex();
                let edge = color.lit(0.9 * brightness(normal)).hex();
                let outline = self.outline(&corners);
                drawn.push_str(&format!(r#"<path d="{outline}" fill="{fill}" stroke="{edge}" stroke-width="0.8" stroke-linejoin="round"/>"#));
            }
        }
        let depth_m = self.camera.project(cuboid.centre.map(f64::from)).depth_m;
        self.shapes.push((depth_m, drawn));
    }

    /// Adds a capsule, lighter on the side of the light.
    pub(super) fn capsule(&mut self, capsule: &Capsule, color: Rgb) {
        let radius_m = f64::from(capsule.radius_m);
        let (from, to) = (capsule.from.map(f64::from), capsule.to.map(f64::from));
        let (a, b) = (self.camera.project(from), self.camera.project(to));
        let (radius_a, radius_b) = (radius_m * a.scale, radius_m * b.scale);
        let length_px = (b.x - a.x).hypot(b.y - a.y);
        if length_px < (radius_a - radius_b).abs() + 0.5 {
            let (nearer, depth_m) =
                if a.depth_m < b.depth_m { (from, a.depth_m) } else { (to, b.depth_m) };
            self.sphere(nearer, radius_m, depth_m, color);
            return;
        }
        let (side_x, side_y) = ((b.y - a.y) / length_px, -(b.x - a.x) / length_px);
        let fill = self.gradient_across(&a, [side_x * radius_a, side_y * radius_a], color);
        let mut drawn = String::new();
        drawn.push_str(&format!(r#"<path d="M{:.1} {:.1}L{:.1} {:.1}A{radius_b:.1} {radius_b:.1} 0 0 1 {:.1} {:.1}L{:.1} {:.1}A{radius_a:.1} {radius_a:.1} 0 0 1 {:.1} {:.1}Z" fill="url(#{fill})" stroke="{}" stroke-width="0.8"/>"#,
            a.x + side_x * radius_a,
            a.y + side_y * radius_a,
            b.x + side_x * radius_b,
            b.y + side_y * radius_b,
            b.x - side_x * radius_b,
            b.y - side_y * radius_b,
            a.x - side_x * radius_a,
            a.y - side_y * radius_a,
            a.x + side_x * radius_a,
            a.y + side_y * radius_a,
            color.lit(0.62).hex(),));
        self.shapes.push((self.middle_depth_m(capsule), drawn));
    }

    /// Adds a sphere between `link` and `next`, in front of both.
    pub(super) fn joint(&mut self, link: &Capsule, next: &Capsule, widening: f64, color: Rgb) {
        let depth_m = [link, next]
            .map(|bar| self.middle_depth_m(bar))
            .into_iter()
            .fold(f64::INFINITY, f64::min);
        let radius_m = widening * f64::from(link.radius_m.max(next.radius_m));
        self.sphere(link.to.map(f64::from), radius_m, depth_m - 1e-3, color);
    }

    /// Adds a sphere with a highlight at the given depth.
    fn sphere(&mut self, centre: Vec3, radius_m: f64, depth_m: f64, color: Rgb) {
        let at = self.camera.project(centre);
        let fill = self.gradient_ball(color);
        let radius = radius_m * at.scale;
        let drawn = format!(
            r#"<circle cx="{:.1}" cy="{:.1}" r="{radius:.1}" fill="url(#{fill})"/>"#,
            at.x, at.y
        );
        self.shapes.push((depth_m, drawn));
    }

    /// Adds a goal: a translucent sphere, and a ring on the table below it.
    pub(super) fn goal(&mut self, centre: Vec3, radius_m: f64, color: Rgb) {
        let below = [centre[0], centre[1], self.table_z_m];
        let ring = self.circle_on_table(below, radius_m);
        let hex = color.lit(0.85).hex();
        self.ground.push_str(&format!(r#"<path d="{ring}" fill="{hex}" fill-opacity="0.14" stroke="{hex}" stroke-width="1.6" stroke-dasharray="5 4"/>"#));
        if centre[2] - self.table_z_m > radius_m {
            let (top, foot) = (self.camera.project(centre), self.camera.project(below));
            self.ground.push_str(&format!(r#"<path d="M{:.1} {:.1}L{:.1} {:.1}" stroke="{hex}" stroke-width="1.2" stroke-dasharray="2 4"/>"#,
                foot.x, foot.y, top.x, top.y));
        }
        let at = self.camera.project(centre);
        let drawn = format!(
            r#"<circle cx="{:.1}" cy="{:.1}" r="{:.1}" fill="{}" fill-opacity="0.26" stroke="{hex}" stroke-opacity="0.75" stroke-width="1.4"/>"#,
            at.x,
            at.y,
            radius_m * at.scale,
            color.lit(1.15).hex()
        );
        self.shapes.push((at.depth_m - radius_m, drawn));
    }

    /// Adds a pedestal on the table.
    pub(super) fn pedestal(&mut self, base: Vec3, radius_m: f64, height_m: f64, color: Rgb) {
        let top_centre = [base[0], base[1], base[2] + height_m];
        let (bottom, top) =
            (self.circle_on_table(base, radius_m), self.circle_on_table(top_centre, radius_m));
        let (low, high) = (self.camera.project(base), self.camera.project(top_centre));
        let wall = format!(
            "M{:.1} {:.1}L{:.1} {:.1}L{:.1} {:.1}L{:.1} {:.1}Z",
            low.x - radius_m * low.scale,
            low.y,
            low.x + radius_m * low.scale,
            low.y,
            high.x + radius_m * high.scale,
            high.y,
            high.x - radius_m * high.scale,
            high.y
        );
        let (side, lid) = (color.lit(0.75).hex(), color.lit(1.1).hex());
        let drawn =
            format!(r#"<path d="{bottom}{wall}" fill="{side}"/><path d="{top}" fill="{lid}"/>"#);
        // The depth of the far rim, so that the arm is drawn in front.
        self.shapes.push((low.depth_m + radius_m, drawn));
        let shadow =
            self.circle_on_table([base[0] + 0.02, base[1] + 0.02, self.table_z_m], 1.1 * radius_m);
        self.shadows.push_str(&format!(r#"<path d="{shadow}"/>"#));
    }

    /// Adds the shadow of a capsule.
    pub(super) fn shadow_of_capsule(&mut self, capsule: &Capsule) {
        let [a, b] = [capsule.from, capsule.to]
            .map(|end| self.camera.project(self.shadow_point(end.map(f64::from))));
        let width = 1.7 * f64::from(capsule.radius_m) * 0.5 * (a.scale + b.scale);
        self.shadows.push_str(&format!(r##"<path d="M{:.1} {:.1}L{:.1} {:.1}" stroke="#000" stroke-width="{width:.1}" stroke-linecap="round"/>"##,
            a.x, a.y, b.x, b.y));
    }

    /// Adds the shadow of a box.
    pub(super) fn shadow_of_cuboid(&mut self, cuboid: &Cuboid) {
        for (corners, _) in faces(cuboid) {
            let corners = corners.map(|corner| self.shadow_point(corner));
            let outline = self.outline(&corners);
            self.shadows.push_str(&format!(r#"<path d="{outline}"/>"#));
        }
    }

    /// Returns the picture as SVG.
    pub(super) fn finish(mut self, view: &View) -> String {
        self.shapes.sort_by(|a, b| b.0.total_cmp(&a.0));
        let shapes: String = self.shapes.into_iter().map(|(_, shape)| shape).collect();
        let (width, height) = (view.width, view.height);
        let caption = view.caption.as_deref().map(caption).unwrap_or_default();
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\">\
             <defs><linearGradient id=\"sky\" x1=\"0\" y1=\"0\" x2=\"0\" y2=\"1\"><stop offset=\"0\" stop-color=\"#f7f9fb\"/>\
             <stop offset=\"1\" stop-color=\"#dfe5eb\"/></linearGradient><filter id=\"soft\" x=\"-5%\" y=\"-5%\" width=\"110%\" \
             height=\"110%\"><feGaussianBlur stdDeviation=\"4\"/></filter>{}</defs>\
             <rect width=\"100%\" height=\"100%\" fill=\"url(#sky)\"/>{}\
             <g clip-path=\"url(#top)\"><g opacity=\"0.2\" filter=\"url(#soft)\">{}</g></g>{shapes}{caption}</svg>\n",
            self.definitions, self.ground, self.shadows
        )
    }

    fn middle_depth_m(&self, bar: &Capsule) -> f64 {
        let [from, to] =
            [bar.from, bar.to].map(|end| self.camera.project(end.map(f64::from)).depth_m);
        0.5 * (from + to)
    }

    /// Projects `point` onto the table along the light.
    fn shadow_point(&self, point: Vec3) -> Vec3 {
        let height_m = (point[2] - self.table_z_m).max(0.0);
        difference(point, scaled(LIGHT, height_m / LIGHT[2]))
    }

    fn outline(&self, corners: &[Vec3]) -> String {
        let mut outline = String::new();
        for (i, corner) in corners.iter().enumerate() {
            let at = self.camera.project(*corner);
            outline.push_str(&format!("{}{:.1} {:.1}", if i == 0 { 'M' } else { 'L' }, at.x, at.y));
        }
        outline.push('Z');
        outline
    }

    fn circle_on_table(&self, centre: Vec3, radius_m: f64) -> String {
        let corner = |i: u32| {
            let angle_rad = f64::from(i) / f64::from(N_CORNERS) * std::f64::consts::TAU;
            sum(centre, [radius_m * angle_rad.cos(), radius_m * angle_rad.sin(), 0.0])
        };
        self.outline(&(0..N_CORNERS).map(corner).collect::<Vec<_>>())
    }

    /// Defines a gradient across a capsule and returns its id. `side` points from the axis to the left side, pixels.
    fn gradient_across(&mut self, axis: &Projected, side: [f64; 2], color: Rgb) -> String {
        let id = self.next_id();
        // In the picture the light comes from the upper left.
        let lit_side = if -0.6 * side[0] - 0.8 * side[1] >= 0.0 { 1.0 } else { -1.0 };
        let [dx, dy] = side.map(|x| lit_side * x);
        self.definitions.push_str(&format!(r#"<linearGradient id="{id}" gradientUnits="userSpaceOnUse" x1="{:.1}" y1="{:.1}" x2="{:.1}" y2="{:.1}">{}</linearGradient>"#,
            axis.x + dx,
            axis.y + dy,
            axis.x - dx,
            axis.y - dy,
            stops(&[
                (0.0, color.lit(0.94)),
                (0.28, color.lit(1.5)),
                (0.62, color.lit(0.9)),
                (1.0, color.lit(0.6))
            ])));
        id
    }

    fn gradient_ball(&mut self, color: Rgb) -> String {
        let id = self.next_id();
        self.definitions.push_str(&format!(
            r#"<radialGradient id="{id}" cx="0.36" cy="0.3" r="0.75">{}</radialGradient>"#,
            stops(&[(0.0, color.lit(1.45)), (0.45, color), (1.0, color.lit(0.58))])
        ));
        id
    }

    fn next_id(&mut self) -> String {
        self.n_gradients += 1;
        format!("g{}", self.n_gradients)
    }
}

fn stops(stops: &[(f64, Rgb)]) -> String {
    stops
        .iter()
        .map(|(offset, color)| format!(r#"<stop offset="{offset}" stop-color="{}"/>"#, color.hex()))
        .collect()
}

fn caption(text: &str) -> String {
    let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    format!(
        r##"<text x="22" y="34" font-family="{FONT}" font-size="16" fill="#24292f">{text}</text>"##
    )
}

/// Returns the six faces of a box: their corners in order, and their outward normals.
fn faces(cuboid: &Cuboid) -> [([Vec3; 4], Vec3); 6] {
    let half_m = cuboid.half_extents_m.map(f64::from);
    let centre = cuboid.centre.map(f64::from);
    std::array::from_fn(|face| {
        let (axis, sign) = (face / 2, if face % 2 == 0 { 1.0 } else { -1.0 });
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let corner = |(su, sv): (f64, f64)| {
            let mut local = [0.0; 3];
            (local[axis], local[u], local[v]) =
                (sign * half_m[axis], su * half_m[u], sv * half_m[v]);
            sum(centre, rotated(cuboid.orientation, local))
        };
        let mut normal = [0.0; 3];
        normal[axis] = sign;
        let corners = [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)].map(corner);
        (corners, rotated(cuboid.orientation, normal))
    })
}

#[cfg(test)]
mod tests {
    use super::super::camera::dot;
    use super::*;

    #[test]
    fn the_normals_of_a_box_point_outward() {
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let cuboid = Cuboid {
            centre: [1.0, 2.0, 3.0],
            orientation: [0.0, half, 0.0, half],
            half_extents_m: [0.1, 0.2, 0.3],
        };
        for (corners, normal) in faces(&cuboid) {
            let middle = scaled(corners.into_iter().fold([0.0; 3], sum), 0.25);
            let outward = difference(middle, [1.0, 2.0, 3.0]);
            let distance_m = dot(outward, outward).sqrt();
            assert!((dot(outward, normal) - distance_m).abs() < 1e-6, "{outward:?} {normal:?}");
        }
    }
}
