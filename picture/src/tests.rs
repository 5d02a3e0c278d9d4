//! Films and pictures of a small scene.

use gif::{ColorOutput, DecodeOptions};
use tandem_core::scene::{ArmScene, Capsule, Cuboid, Scene};

use crate::Error;
use crate::film::{Film, FilmEpisode, FilmStep, draw_step, film_gif, film_gif_with};
use crate::interpolate::between;
use crate::painter::{render, render_achieved};
use crate::raster::Raster;
use crate::strip::{film_strip, picture_png};

const UPRIGHT: [f32; 4] = [0.0, 0.0, 0.0, 1.0];
const FILM: Film = Film { width: 96, height: 64, speed: 0.5 };
const CONTROL_STEP_S: f64 = 0.04;

/// An arm whose hand is above a cube at `y_m`.
pub(crate) fn scene(time_s: f64, y_m: f32) -> Scene {
    let cuboid =
        |centre, half_m| Cuboid { centre, orientation: UPRIGHT, half_extents_m: [half_m; 3] };
    let (elbow, hand) = ([-0.3, 0.0, 0.4], [0.0, y_m, 0.2]);
    Scene {
        time_s,
        arms: vec![ArmScene {
            base: [-0.5, 0.0, 0.0],
            joint_angles_rad: [0.0; 6],
            joint_points: Vec::new(),
            links: vec![
                Capsule { from: [-0.5, 0.0, 0.2], to: elbow, radius_m: 0.03 },
                Capsule { from: elbow, to: hand, radius_m: 0.03 },
            ],
            hand: vec![cuboid(hand, 0.03)],
            end_effector: hand,
        }],
        objects: vec![cuboid([0.0, y_m, 0.03], 0.03)],
        goals: vec![[0.0, 0.1, 0.03]],
        goal_tolerance_m: 0.05,
        table: Cuboid {
            centre: [0.0, 0.0, -0.02],
            orientation: UPRIGHT,
            half_extents_m: [0.7, 0.45, 0.02],
        },
    }
}

/// The cube moves to its goal in `n_moving` control steps and stays there for `n_resting`.
fn episode(n_moving: u16, n_resting: u16) -> FilmEpisode {
    let step = |idx: u16| {
        let share = f32::from(idx.min(n_moving)) / f32::from(n_moving.max(1));
        let y_m = 0.2 * share - 0.1;
        let achieved = vec![(y_m - 0.1).abs() <= 0.05];
        FilmStep { scene: scene(CONTROL_STEP_S * f64::from(idx), y_m), achieved }
    };
    FilmEpisode {
        title: "episode 7".to_owned(),
        steps: (0..=n_moving + n_resting).map(step).collect(),
    }
}

/// Decodes a film: its last picture, and how long each frame stays, hundredths of a second.
fn decoded(bytes: &[u8]) -> (Vec<u8>, Vec<u16>) {
    let mut options = DecodeOptions::new();
    options.set_color_output(ColorOutput::RGBA);
    let mut decoder = options.read_info(bytes).expect("a GIF");
    let width = usize::from(decoder.width());
    let mut rgb = vec![0; 3 * width * usize::from(decoder.height())];
    let mut delays_cs = Vec::new();
    while let Some(frame) = decoder.read_next_frame().expect("a frame") {
        delays_cs.push(frame.delay);
        for (idx, pixel) in frame.buffer.chunks_exact(4).enumerate() {
            let (row, column) = (idx / usize::from(frame.width), idx % usize::from(frame.width));
            let place = (row + usize::from(frame.top)) * width + column + usize::from(frame.left);
            if pixel[3] > 0 {
                rgb[3 * place..3 * place + 3].copy_from_slice(&pixel[..3]);
            }
        }
    }
    (rgb, delays_cs)
}

#[test]
fn a_film_ends_with_the_last_scene_shortly_after_it_is_at_rest() {
    let episode = episode(6, 20);
    let (shown, delays_cs) = decoded(&film_gif(std::slice::from_ref(&episode), &FILM).unwrap());
    // Eight control steps at half speed, two frames each, and the last scene.
    assert_eq!(delays_cs.len(), 17);
    assert!(delays_cs[1..16].iter().all(|delay_cs| *delay_cs == 4), "{delays_cs:?}");
    let drawn = draw_step("episode 7", &episode.steps[8], true, (FILM.width, FILM.height));
    let differences = shown.iter().zip(&drawn.rgb).map(|(a, b)| u32::from(a.abs_diff(*b)));
    let mean = f64::from(differences.clone().sum::<u32>()) / drawn.rgb.len() as f64;
    assert!(mean < 3.0, "{mean}");
    assert!(differences.max() < Some(60));
    assert_eq!(decoded(&film_gif(&[episode], &Film { speed: 1.0, ..FILM }).unwrap()).1.len(), 9);
}

#[test]
fn a_film_has_the_same_bytes_on_any_number_of_threads() {
    let episodes = [episode(4, 0), episode(2, 0)];
    let on = |n_threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
        pool.install(|| {
            (film_gif(&episodes, &FILM).unwrap(), film_strip(&episodes, &FILM).unwrap())
        })
    };
    assert_eq!(on(1), on(3));
}

#[test]
fn frames_without_visible_motion_show_the_same_bodies_and_the_time_of_each() {
    // The cube moves by a hundredth of a pixel and then by several.
    let step = |time_s: f64, y_m: f32| FilmStep { scene: scene(time_s, y_m), achieved: vec![] };
    let still = FilmEpisode {
        title: String::new(),
        steps: vec![step(0.0, 0.0), step(0.4, 1e-4), step(0.8, 0.2)],
    };
    let film = Film { width: 160, height: 100, speed: 1.0 };
    let mut frames = Vec::new();
    let bytes = film_gif_with(&[still], &film, |n, n_all| frames.push((n, n_all))).unwrap();
    assert_eq!(frames.len(), 21, "ten frames per step, and the last scene");
    assert_eq!((frames[0], frames[20]), ((1, 21), (21, 21)));
    let mut decoder = DecodeOptions::new().read_info(bytes.as_slice()).unwrap();
    let mut rows = Vec::new();
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        rows.push(usize::from(frame.top) + usize::from(frame.height));
    }
    let caption_rows = 40;
    assert!(rows[1..8].iter().all(|bottom| *bottom < caption_rows), "only the time: {rows:?}");
    assert!(rows[13..20].iter().all(|bottom| *bottom > caption_rows), "the cube: {rows:?}");
}

#[test]
fn a_strip_has_rows_of_four_pictures() {
    let size = |episodes: &[FilmEpisode]| {
        let png = film_strip(episodes, &FILM).unwrap();
        let reader = png::Decoder::new(std::io::Cursor::new(png)).read_info().unwrap();
        (reader.info().width, reader.info().height)
    };
    let four = 4 * 96 + 3 * 6;
    assert_eq!(size(&[episode(30, 0)]), (four, 2 * 64 + 6));
    assert_eq!(size(&[episode(30, 0), episode(3, 0)]), (four, 3 * 64 + 2 * 6));
    assert_eq!(size(&[episode(0, 0)]), (96, 64));
}

#[test]
fn what_cannot_be_drawn_is_refused() {
    let film = |width, speed| film_gif(&[episode(1, 0)], &Film { width, speed, ..FILM });
    assert!(matches!(film(63, 1.0), Err(Error::Size { .. })));
    assert!(matches!(film(4097, 1.0), Err(Error::Size { .. })));
    for speed in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(film(96, speed), Err(Error::Speed(_))), "{speed}");
    }
    let empty = FilmEpisode { title: String::new(), steps: Vec::new() };
    assert!(matches!(film_gif(&[], &FILM), Err(Error::NoScenes)));
    assert!(matches!(film_strip(&[empty], &FILM), Err(Error::NoScenes)));
    assert!(picture_png("", &episode(1, 0).steps[0], (0, 64)).is_err());
}

/// The mean colour of a picture: red, green and blue.
fn mean_color(raster: &Raster) -> [f64; 3] {
    let n_pixels = (raster.width * raster.height) as f64;
    let mean = |channel: usize| {
        raster.rgb.iter().skip(channel).step_by(3).map(|value| f64::from(*value)).sum::<f64>()
    };
    [0, 1, 2].map(|channel| mean(channel) / n_pixels)
}

#[test]
fn a_body_casts_a_shadow_and_an_achieved_goal_has_a_stronger_colour() {
    let with_arm = scene(0.0, -0.2);
    // The arm as seen from the table only: a floating cube outside of the picture's centre.
    let mut high = with_arm.clone();
    high.objects[0].centre[2] = 0.5;
    let table = |scene: &Scene| {
        let raster = render(scene, 96, 64);
        raster.rgb.chunks_exact(3).filter(|rgb| rgb[0] > rgb[2] && rgb[0] < 215).count()
    };
    let mut empty = with_arm.clone();
    (empty.objects, empty.goals) = (Vec::new(), Vec::new());
    (empty.arms[0].links, empty.arms[0].hand) = (Vec::new(), Vec::new());
    assert!(table(&with_arm) > table(&empty) + 20, "{} {}", table(&with_arm), table(&empty));
    let goal = |achieved: bool| mean_color(&render_achieved(&with_arm, &[achieved], 96, 64));
    let (pending, achieved) = (goal(false), goal(true));
    assert!(achieved[0] < pending[0] - 0.05, "more blue: {achieved:?} {pending:?}");
    assert_ne!(render(&high, 96, 64), render(&with_arm, 96, 64));
}

#[test]
fn a_scene_between_two_others_takes_the_shorter_way() {
    let (before, mut after) = (scene(0.0, 0.0), scene(1.0, 0.1));
    let half = std::f32::consts::FRAC_1_SQRT_2;
    after.objects[0].orientation = [0.0, 0.0, -half, -half];
    let middle = between(&before, &after, 0.5);
    assert_eq!((middle.time_s, middle.objects[0].centre[1]), (0.5, 0.05));
    let [_, _, z, w] = middle.objects[0].orientation;
    assert!((z.atan2(w).to_degrees() - 22.5).abs() < 1e-3, "an eighth of a turn: {z} {w}");
    assert_eq!(between(&before, &after, 0.0), before);
}
