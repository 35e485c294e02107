//! A camera from its views of a board: closed form ([`zhang`]), then all at once ([`refine`]), with [`coverage`] and
//! [`cross_validation`] saying how far it can be trusted, a [`report`] and a [`plot`].

pub mod coverage;
pub mod cross_validation;
pub mod lens;
pub mod plot;
pub mod pose;
pub mod refine;
pub mod report;
pub mod zhang;
