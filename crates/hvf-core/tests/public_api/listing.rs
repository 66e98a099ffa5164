//! What a crate offers others, read off its sources: one line for everything public.
//!
//! Follows modules and `pub use` from the root. What macros make is not seen.

use std::collections::{BTreeMap, BTreeSet};

use syn::punctuated::Punctuated;
use syn::{
    parse_quote, Attribute, Expr, Fields, ImplItem, Item, ItemImpl, Meta, TraitItem, Type, UseTree,
    Visibility,
};

/// Names from the root of the crate on.
type Path = Vec<String>;

/// A module's own items, and what it imports.
#[derive(Default)]
struct Module {
    items: Vec<Item>,
    /// Modules in it, and whether they are public.
    modules: BTreeMap<String, bool>,
    imports: Vec<Import>,
}

/// One name that is imported, or all of a module's.
struct Import {
    public: bool,
    /// `None` for all of them.
    name: Option<String>,
    from: Path,
}

/// The modules of a crate by path.
#[derive(Default)]
struct Crate {
    modules: BTreeMap<Path, Module>,
}

/// Lines for everything public, sorted. `read` gives the text of a file below `src`.
pub fn listing(read: &dyn Fn(&str) -> Option<String>) -> Vec<String> {
    let mut found = Crate::default();
    found.load(&Vec::new(), parsed(read, "lib.rs").expect("a lib.rs"), read);
    found.lines()
}

fn parsed(read: &dyn Fn(&str) -> Option<String>, file: &str) -> Option<Vec<Item>> {
    let text = read(file)?;
    Some(syn::parse_file(&text).unwrap_or_else(|error| panic!("{file}: {error}")).items)
}

impl Crate {
    /// Takes in a module and those in it.
    fn load(&mut self, path: &Path, items: Vec<Item>, read: &dyn Fn(&str) -> Option<String>) {
        let mut module = Module::default();
        for item in items {
            match item {
                item if is_test(attributes(&item)) => {}
                Item::Mod(inner) => {
                    let name = inner.ident.to_string();
                    let below = joined(path, &name);
                    let file = below.join("/");
                    let items = match inner.content {
                        Some((_, items)) => items,
                        None => parsed(read, &format!("{file}.rs"))
                            .or_else(|| parsed(read, &format!("{file}/mod.rs")))
                            .unwrap_or_else(|| panic!("no source of {file}")),
                    };
                    module.modules.insert(name, is_public(&inner.vis));
                    self.load(&below, items, read);
                }
                Item::Use(import) => {
                    flatten(&import.tree, &[], is_public(&import.vis), &mut module.imports);
                }
                item => module.items.push(item),
            }
        }
        self.modules.insert(path.clone(), module);
    }

    /// Where a path that is written in a module leads: to a module or an item of this crate.
    fn resolve(&self, from: &Path, path: &[String], depth: usize) -> Option<Path> {
        let (first, rest) = path.split_first()?;
        let start = match first.as_str() {
            "crate" => Some(Vec::new()),
            "self" => Some(from.clone()),
            "super" => Some(from[..from.len().saturating_sub(1)].to_vec()),
            name => self.named(from, name, depth),
        }?;
        if rest.is_empty() || !self.modules.contains_key(&start) {
            return rest.is_empty().then_some(start);
        }
        let inside = if rest[0] == "super" { rest.to_vec() } else { joined_front("self", rest) };
        match rest {
            [name] if name != "super" => self.named(&start, name, depth),
            [name, more @ ..] if name != "super" => {
                let next = self.named(&start, name, depth)?;
                self.resolve(&next, &joined_front("self", more), depth)
            }
            _ => self.resolve(&start, &inside, depth),
        }
    }

    /// What a name means in a module.
    fn named(&self, module: &Path, name: &str, depth: usize) -> Option<Path> {
        let found = self.modules.get(module)?;
        let declares = |item: &Item| declared(item).is_some_and(|declared| declared == name);
        if found.modules.contains_key(name) || found.items.iter().any(declares) {
            return Some(joined(module, name));
        }
        // Imports may go round in circles.
        let depth = depth.checked_sub(1)?;
        let by_name = found.imports.iter().filter(|import| import.name.as_deref() == Some(name));
        let direct = by_name.filter(|import| import.from.first().is_some_and(|x| x != name));
        let mut direct = direct.filter_map(|import| self.resolve(module, &import.from, depth));
        direct.next().or_else(|| {
            let globs = found.imports.iter().filter(|import| import.name.is_none());
            let mut globs = globs.filter_map(|import| self.resolve(module, &import.from, depth));
            globs.find_map(|target| self.named(&target, name, depth))
        })
    }

    /// Items that others can name, and lines for the modules and imports that lead to them.
    fn reached(&self) -> (BTreeSet<Path>, Vec<String>) {
        let (mut items, mut lines) = (BTreeSet::new(), Vec::new());
        let (mut seen, mut waiting) = (BTreeSet::new(), vec![Path::new()]);
        while let Some(path) = waiting.pop() {
            let Some(module) = self.modules.get(&path).filter(|_| seen.insert(path.clone())) else {
                continue;
            };
            let public = module.items.iter().filter(|item| visibility(item).is_some_and(is_public));
            items.extend(public.filter_map(declared).map(|name| joined(&path, &name)));
            for (name, _) in module.modules.iter().filter(|(_, public)| **public) {
                lines.push(format!("pub mod {}", shown(&joined(&path, name))));
                waiting.push(joined(&path, name));
            }
            for import in module.imports.iter().filter(|import| import.public) {
                let target = self.resolve(&path, &import.from, DEPTH);
                let shown_target = target.as_ref().map_or(import.from.join("::"), shown);
                let name = import.name.as_deref().unwrap_or("*");
                lines.push(format!("pub use {shown_target} as {}", shown(&joined(&path, name))));
                match target {
                    Some(target) if self.modules.contains_key(&target) => waiting.push(target),
                    Some(target) => drop(items.insert(target)),
                    None => {}
                }
            }
        }
        (items, lines)
    }

    fn lines(&self) -> Vec<String> {
        let (reached, mut lines) = self.reached();
        for (path, module) in &self.modules {
            for item in &module.items {
                if let Item::Impl(block) = item {
                    lines.extend(self.of_impl(path, block, &reached));
                } else if let Some(name) = declared(item).map(|name| joined(path, &name)) {
                    if reached.contains(&name) {
                        lines.push(format!("{}: {}", shown(&name), written(bare(item.clone()))));
                    }
                }
            }
        }
        lines.sort();
        lines
    }

    /// What an `impl` adds to a type, or that the type has a trait.
    fn of_impl(&self, path: &Path, block: &ItemImpl, reached: &BTreeSet<Path>) -> Vec<String> {
        let names = |path: &syn::Path| -> Path {
            path.segments.iter().map(|segment| segment.ident.to_string()).collect()
        };
        let open = |at: &syn::Path| match self.resolve(path, &names(at), DEPTH) {
            Some(target) => reached.contains(&target),
            None => true,
        };
        let of = match &*block.self_ty {
            Type::Path(of) if !open(&of.path) => return Vec::new(),
            Type::Path(of) => self.resolve(path, &names(&of.path), DEPTH),
            _ => None,
        };
        let mut head = block.clone();
        head.attrs.clear();
        head.items.clear();
        let head = written(Item::Impl(head));
        let place = shown(of.as_ref().unwrap_or(path));
        if let Some((of_trait, _)) = &block.trait_ {
            return if open(of_trait) { vec![format!("{place}: {head}")] } else { Vec::new() };
        }
        let parts = block.items.iter().filter_map(|part| match part {
            ImplItem::Fn(function) if is_public(&function.vis) => {
                let (visibility, signature) = (&function.vis, &function.sig);
                Some(parse_quote!(#visibility #signature {}))
            }
            ImplItem::Const(constant) if is_public(&constant.vis) => {
                let (name, kind) = (&constant.ident, &constant.ty);
                Some(parse_quote!(pub const #name: #kind = _;))
            }
            _ => None,
        });
        parts.map(|part| format!("{place}: {head}: {}", written(bare(part)))).collect()
    }
}

/// How many imports may follow upon each other.
const DEPTH: usize = 8;

fn joined(path: &[String], name: &str) -> Path {
    path.iter().cloned().chain([name.to_string()]).collect()
}

fn joined_front(name: &str, path: &[String]) -> Path {
    [name.to_string()].into_iter().chain(path.iter().cloned()).collect()
}

fn shown(path: &Path) -> String {
    path.join("::")
}

fn is_public(visibility: &Visibility) -> bool {
    matches!(visibility, Visibility::Public(_))
}

/// Whether an item is there in tests only.
fn is_test(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| match &attribute.meta {
        Meta::List(list) => list.path.is_ident("cfg") && list.tokens.to_string() == "test",
        _ => false,
    })
}

fn flatten(tree: &UseTree, before: &[String], public: bool, imports: &mut Vec<Import>) {
    let mut add = |name: Option<String>, from| imports.push(Import { public, name, from });
    match tree {
        UseTree::Path(path) => {
            flatten(&path.tree, &joined(before, &path.ident.to_string()), public, imports);
        }
        UseTree::Name(name) if name.ident == "self" => {
            add(before.last().cloned(), before.to_vec());
        }
        UseTree::Name(name) => {
            let name = name.ident.to_string();
            add(Some(name.clone()), joined(before, &name));
        }
        UseTree::Rename(renamed) => {
            let from = joined(before, &renamed.ident.to_string());
            add(Some(renamed.rename.to_string()), from);
        }
        UseTree::Glob(_) => add(None, before.to_vec()),
        UseTree::Group(group) => {
            for tree in &group.items {
                flatten(tree, before, public, imports);
            }
        }
    }
}

/// Attributes, visibility and name of an item that has a name.
macro_rules! of_named {
    ($item:expr, $other:expr, $found:ident => $value:expr) => {
        match $item {
            Item::Const($found) => $value,
            Item::Enum($found) => $value,
            Item::Static($found) => $value,
            Item::Struct($found) => $value,
            Item::Trait($found) => $value,
            Item::Type($found) => $value,
            Item::Union($found) => $value,
            _ => $other,
        }
    };
}

fn attributes(item: &Item) -> &[Attribute] {
    match item {
        Item::Fn(function) => &function.attrs,
        Item::Impl(block) => &block.attrs,
        Item::Mod(module) => &module.attrs,
        Item::Use(import) => &import.attrs,
        item => of_named!(item, &[], found => &found.attrs),
    }
}

fn visibility(item: &Item) -> Option<&Visibility> {
    match item {
        Item::Fn(function) => Some(&function.vis),
        item => of_named!(item, None, found => Some(&found.vis)),
    }
}

fn declared(item: &Item) -> Option<String> {
    match item {
        Item::Fn(function) => Some(function.sig.ident.to_string()),
        item => of_named!(item, None, found => Some(found.ident.to_string())),
    }
}

/// An item without what others do not see: documentation, bodies, values, private fields.
fn bare(mut item: Item) -> Item {
    let kept = |attribute: &Attribute| {
        let path = attribute.path();
        path.is_ident("derive") || path.is_ident("non_exhaustive")
    };
    match &mut item {
        Item::Fn(function) => {
            function.attrs.clear();
            function.block = parse_quote!({});
        }
        item => of_named!(item, (), found => found.attrs.retain(kept)),
    }
    let no_value = || -> Box<Expr> { parse_quote!(_) };
    match &mut item {
        Item::Const(constant) => constant.expr = no_value(),
        Item::Static(constant) => constant.expr = no_value(),
        Item::Struct(found) => public_fields(&mut found.fields),
        Item::Enum(found) => {
            for variant in &mut found.variants {
                variant.attrs.clear();
                variant.fields.iter_mut().for_each(|field| field.attrs.clear());
            }
        }
        Item::Trait(found) => {
            for part in &mut found.items {
                match part {
                    TraitItem::Fn(function) => {
                        function.attrs.clear();
                        function.default = function.default.as_ref().map(|_| parse_quote!({}));
                    }
                    TraitItem::Type(kind) => kind.attrs.clear(),
                    TraitItem::Const(constant) => constant.attrs.clear(),
                    _ => {}
                }
            }
        }
        _ => {}
    }
    item
}

/// Leaves out private fields, and says so.
fn public_fields(fields: &mut Fields) {
    fields.iter_mut().for_each(|field| field.attrs.clear());
    if let Fields::Named(named) = fields {
        let all = std::mem::replace(&mut named.named, Punctuated::new());
        let private = all.iter().any(|field| !is_public(&field.vis));
        named.named.extend(all.into_iter().filter(|field| is_public(&field.vis)));
        if private {
            let rest: syn::FieldsNamed = parse_quote!({ __: _ });
            named.named.extend(rest.named);
        }
    }
}

/// An item on one line.
fn written(item: Item) -> String {
    let file: syn::File = parse_quote!(#item);
    let text = prettyplease::unparse(&file);
    let mut line = text.split_whitespace().collect::<Vec<_>>().join(" ");
    for (broken, whole) in
        [("( ", "("), (", )", ")"), ("< ", "<"), (", >", ">"), (", }", " }"), ("__: _", "..")]
    {
        line = line.replace(broken, whole);
    }
    line.trim_end_matches(" {}").to_string()
}
