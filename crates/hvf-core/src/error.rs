//! The one error type of the crate.

/// What went wrong, and in which argument.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An argument has the wrong shape, range or value.
    #[error("{argument}: {problem}")]
    Invalid {
        /// Name of the argument, as the caller wrote it.
        argument: &'static str,
        /// What was expected and what was found.
        problem: String,
    },
    /// A model answered with something that cannot be planned with (wrong shape, all NaN).
    #[error("model: {0}")]
    Model(String),
    /// The caller asked to stop (Ctrl-C).
    #[error("interrupted")]
    Interrupted,
    /// An error raised by a model implemented outside this crate, passed through unchanged.
    #[error(transparent)]
    External(#[from] Box<dyn std::error::Error + Send + Sync>),
}

impl Error {
    /// An [`Error::Invalid`] about `argument`.
    pub fn invalid(argument: &'static str, problem: impl Into<String>) -> Self {
        Error::Invalid { argument, problem: problem.into() }
    }
}

/// Result with this crate's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;
