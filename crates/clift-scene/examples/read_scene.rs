//! Reads a scene file and prints its contents.
//!
//! `cargo run --release -p clift-scene --example read_scene -- room.clift`

use std::path::Path;

use clift_scene::Scene;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("usage: read_scene SCENE.clift")?;
    let (scene, format) = Scene::read(Path::new(&path))?;
    println!("scene {}, encoded with {}", scene.key, scene.model_path);
    println!("{} {} tokens of width {} in {format}", scene.num_tokens(), scene.kind.name(), scene.model.dim);
    println!(
        "{} bytes; {} context views of {} x {}",
        std::fs::metadata(&path)?.len(),
        scene.context.len(),
        scene.width,
        scene.height
    );
    for (frame, camera) in scene.context_frames.iter().zip(&scene.context) {
        println!("frame {frame}: [fx, fy, cx, cy] = {:?}", camera.intrinsics.to_array());
    }
    for (id, ray) in scene.token_ids.iter().zip(scene.token_rays()).take(3) {
        println!("token of patch {id}: ray from {:.3?} along {:.3?}", ray.origin.to_array(), ray.direction.to_array());
    }
    Ok(())
}
