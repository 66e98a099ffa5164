//! What this crate offers others is what `listing.txt` says, line by line.
//!
//! After a change that is meant: `PUBLIC_API=write cargo test --release -p hvf-core --test public_api`

mod listing;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::{env, fs};

use listing::listing;

#[test]
fn what_is_public_is_what_the_listing_says() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let found = listing(&|file| fs::read_to_string(root.join("src").join(file)).ok());
    let file = root.join("tests/public_api/listing.txt");
    if env::var("PUBLIC_API").is_ok_and(|what| what == "write") {
        fs::write(&file, found.join("\n") + "\n").expect("a file that can be written");
        return;
    }
    let said = fs::read_to_string(&file).expect("listing.txt beside this test");
    let (said, found): (BTreeSet<_>, BTreeSet<_>) =
        (said.lines().collect(), found.iter().map(String::as_str).collect());
    let gone = said.difference(&found).map(|line| format!("- {line}\n"));
    let new = found.difference(&said).map(|line| format!("+ {line}\n"));
    let changes: String = gone.chain(new).collect();
    assert!(
        changes.is_empty(),
        "the public interface changed:\n{changes}If that is meant, note it in CHANGELOG.md and run\n\
         PUBLIC_API=write cargo test --release -p hvf-core --test public_api"
    );
}

/// The listing of a crate of these files.
fn of(files: &[(&str, &str)]) -> Vec<String> {
    let files: BTreeMap<_, _> = files.iter().copied().collect();
    listing(&|file| files.get(file).map(ToString::to_string))
}

#[test]
fn only_what_others_can_name_is_listed() {
    let inner = "
        /// Doc.
        #[derive(Clone)] pub struct Seen { /// Doc.
            pub a: u8, b: u8 }
        pub struct Unseen;
        pub(crate) fn ours() {}
        impl Seen { pub fn new(a: u8) -> Self { Self { a, b: 0 } } fn own(&self) {} }
        impl Default for Seen { fn default() -> Self { todo!() } }
        impl Unseen { pub fn new() {} }
        #[cfg(test)] mod tests { pub fn none() {} }";
    let found = of(&[
        ("lib.rs", "pub mod open; mod shut; pub use shut::inner::Seen; pub use std::fmt;"),
        ("open.rs", "pub const C: u8 = 3; const D: u8 = 4; pub use crate::shut as aired;"),
        ("shut/mod.rs", "pub mod inner; pub fn aired() -> u8 { super::open::C }"),
        ("shut/inner.rs", inner),
    ]);
    let without = |name: &str| !found.iter().any(|line| line.contains(name));
    assert!(["D:", "ours", "own", "none"].into_iter().all(without), "{found:#?}");
    // The last `use` makes public what is in a private module.
    assert!(found.contains(&"shut::inner::Unseen: pub struct Unseen;".into()), "{found:#?}");
    let found = of(&[
        ("lib.rs", "pub mod open; mod shut; pub use shut::inner::Seen; pub use std::fmt;"),
        ("open.rs", "pub const C: u8 = 3; const D: u8 = 4;"),
        ("shut/mod.rs", "pub mod inner; pub fn aired() -> u8 { super::open::C }"),
        ("shut/inner.rs", inner),
    ]);
    let expected = [
        "open::C: pub const C: u8 = _;",
        "pub mod open",
        "pub use shut::inner::Seen as Seen",
        "pub use std::fmt as fmt",
        "shut::inner::Seen: #[derive(Clone)] pub struct Seen { pub a: u8, .. }",
        "shut::inner::Seen: impl Default for Seen",
        "shut::inner::Seen: impl Seen: pub fn new(a: u8) -> Self",
    ];
    assert_eq!(found, expected);
}

#[test]
fn signatures_count_and_bodies_do_not() {
    let source = |kind: &str, body: &str| {
        format!(
            "pub trait Model {{ /// Doc.
                type Frames; fn cost(&self, x: {kind}) -> f32 {{ {body} }} fn must(&self); }}
             #[non_exhaustive] pub enum Which {{ One {{ a: {kind} }}, Two }}"
        )
    };
    let of_source = |kind, body| of(&[("lib.rs", &source(kind, body))]);
    assert_eq!(
        of_source("u8", "1.0"),
        [
            "Model: pub trait Model { type Frames; fn cost(&self, x: u8) -> f32 {} fn must(&self); }",
            "Which: #[non_exhaustive] pub enum Which { One { a: u8 }, Two }",
        ]
    );
    assert_eq!(of_source("u8", "1.0"), of_source("u8", "2.0"));
    assert_ne!(of_source("u8", "1.0"), of_source("u16", "1.0"));
}
