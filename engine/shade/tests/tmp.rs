mod support;
use glam::Vec3;
use pbgi_shade::*;
#[test]
fn t() {
    for count in [20, 50, 100, 300] {
    let mut points = vec![];
    let (x, y, z) = (Vec3::X * 2.0, Vec3::Y * 2.0, Vec3::Z * 2.0);
    let low = Vec3::splat(-1.0);
    for (corner, u, v) in
        [(low, z, x), (low + y, x, z), (low, x, y), (low + z, y, x), (low, y, z), (low + x, z, y)]
    {
        support::quad(corner, u, v, count, 1.0, &mut points);
    }
    let (info, mut source) = support::build(&points);
    for msa in [0.2, 0.05, 0.01] {
    let s = pbgi_core::ShadeSettings{max_solid_angle: msa, ..Default::default()};
    let mut shader = Shader::new(&info, s, None).unwrap();
    let n = 400;
    let rs: Vec<Receiver> = (0..n).map(|i| { let f = |k: usize| ((i as f32 + 0.5) * [0.7548777, 0.5698403][k]).fract() * 1.98 - 0.99; Receiver{position: Vec3::new(f(0), -1.0, f(1)), normal: Vec3::Y}}).collect();
    let mut r = vec![Shaded::default(); n];
    let t = std::time::Instant::now();
    shader.shade_group(&rs, &mut source, &mut r).unwrap();
    let mean = r.iter().map(|r| r.occlusion).sum::<f32>() / n as f32;
    let rms = (r.iter().map(|r| (r.occlusion - 1.0).powi(2)).sum::<f32>() / n as f32).sqrt();
    let erms = (r.iter().map(|r| (r.irradiance[0]/std::f32::consts::PI - 1.0).powi(2)).sum::<f32>() / n as f32).sqrt();
    let min = r.iter().map(|r| r.occlusion).fold(1.0, f32::min);
    println!("T {count} {msa} mean {mean} rms {rms} E rms {erms} min {min} cut {} nodes {} us {}", shader.counters().cut_elements / n as u64, shader.counters().nodes_visited/n as u64, t.elapsed().as_micros() as f64 / n as f64);
    }}
}
