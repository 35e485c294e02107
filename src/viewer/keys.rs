//! What the keys of the live window do.

/// What a key asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// The picture as it came.
    Raw,
    /// The picture as it leaves the line.
    Enhanced,
    /// Raw on the left, enhanced on the right.
    Split,
    /// The next stage is the chosen one.
    ChooseStage,
    /// The chosen stage is passed by, or taken in again.
    Bypass,
    /// Less of the chosen stage's effect.
    Weaker,
    /// More of it.
    Stronger,
    /// The picture stands still, or runs again; the line runs on.
    Freeze,
    /// Keep what is shown as a PNG.
    Snapshot,
    /// Where pixels were replaced, and from what.
    Provenance,
    /// The line of figures.
    StatusLine,
    /// The keys.
    Help,
    /// All of the monitor, or a window.
    FullScreen,
    /// End.
    Quit,
}

/// Keys with what they do, as the help shows them.
pub const KEYS: [(&str, Action, &str); 14] = [
    ("1", Action::Raw, "raw"),
    ("2", Action::Enhanced, "enhanced"),
    ("3", Action::Split, "split"),
    ("tab", Action::ChooseStage, "choose stage"),
    ("b", Action::Bypass, "stage on/off"),
    ("-", Action::Weaker, "weaker"),
    ("+", Action::Stronger, "stronger"),
    ("space", Action::Freeze, "freeze"),
    ("s", Action::Snapshot, "snapshot"),
    ("p", Action::Provenance, "what was replaced"),
    ("i", Action::StatusLine, "figures"),
    ("h", Action::Help, "keys"),
    ("f", Action::FullScreen, "full screen"),
    ("q", Action::Quit, "end"),
];

/// What a key does, by its name; Escape brings the raw picture at once.
pub fn action_of(key: &str) -> Option<Action> {
    let key = key.to_lowercase();
    match key.as_str() {
        "escape" => Some(Action::Raw),
        "=" => Some(Action::Stronger),
        key => KEYS.iter().find(|(name, ..)| *name == key).map(|(_, action, _)| *action),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_key_does_one_thing_and_the_raw_picture_is_one_key_away() {
        for (index, (key, action, _)) in KEYS.iter().enumerate() {
            assert_eq!(action_of(&key.to_uppercase()), Some(*action));
            assert!(
                KEYS[index + 1..]
                    .iter()
                    .all(|(other, same, _)| other != key && same != action)
            );
        }
        assert_eq!(action_of("escape"), Some(Action::Raw));
        assert_eq!(action_of("x"), None);
    }
}
