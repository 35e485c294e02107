//! The live window: an event loop, the pixels, the keys. It sleeps until there is a frame, a key, or a tenth of a second has passed.

use std::num::NonZeroU32;
use std::path::PathBuf;
use std::rc::Rc;
use std::sync::Arc;
use std::time::{Duration, Instant};

use softbuffer::{Context, Surface};
use winit::application::ApplicationHandler;
use winit::dpi::LogicalSize;
use winit::event::{ElementState, KeyEvent, WindowEvent};
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop, OwnedDisplayHandle};
use winit::keyboard::{Key, NamedKey};
use winit::window::{Fullscreen, Window, WindowId};

use crate::frame::Frame;
use crate::image::buffer::{Image, Rgb8};
use crate::media::image_files;
use crate::pipeline::control::Controls;
use crate::sinks::display::{Display, Wake};
use crate::viewer::keys::{Action, KEYS, action_of};
use crate::viewer::picture::{Show, fit, put_together, words};

/// How often the line is looked after.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// A key changes a strength by so much.
const STRENGTH_STEP: f32 = 0.1;

/// Why there is no window.
#[derive(Debug, thiserror::Error)]
#[error("no window can be opened ({0})")]
pub struct WindowError(String);

/// A frame has come.
#[derive(Clone, Copy, Debug)]
struct Woken;

/// The way to the window system, before there is a window.
#[derive(Debug)]
pub struct WindowSystem {
    events: EventLoop<Woken>,
}

/// How the line is, as whoever looks after it says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Look {
    /// It runs: figures for people.
    Runs(String),
    /// It has ended.
    Ended,
}

/// Where a window is to be.
#[derive(Clone, Debug)]
pub struct Place {
    /// Its name.
    pub title: String,
    /// All of this monitor, counted from 0; a window when there is none.
    pub full_screen: Option<usize>,
    /// Where snapshots go.
    pub snapshots: PathBuf,
}

impl WindowSystem {
    /// Ask the window system; only the main thread may.
    pub fn open() -> Result<Self, WindowError> {
        let events = EventLoop::<Woken>::with_user_event()
            .build()
            .map_err(|error| WindowError(error.to_string()))?;
        Ok(Self { events })
    }

    /// Wakes the window.
    pub fn wake(&self) -> Wake {
        let proxy = self.events.create_proxy();
        Arc::new(move || {
            // A window that is gone needs no frames.
            let _gone = proxy.send_event(Woken);
        })
    }

    /// Show frames until the line has ended. `look` is called ten times a second; its argument says that the user wants to end.
    pub fn run(
        self,
        place: Place,
        display: Display,
        controls: Arc<Controls>,
        look: impl FnMut(bool) -> Look,
    ) -> Result<(), WindowError> {
        let context = Context::new(self.events.owned_display_handle()).map_err(|error| WindowError(error.to_string()))?;
        let mut app = App {
            place,
            display,
            controls,
            look,
            context,
            pane: None,
            show: Show::default(),
            overlay: false,
            status: true,
            help: false,
            frozen: None,
            chosen: 0,
            figures: String::new(),
            picture: Image::filled(0, 0, [0; 3]),
            notice: None,
            #[expect(clippy::disallowed_methods, reason = "the event loop's own deadlines are of this clock")]
            next_look: Instant::now(),
            wants_to_end: false,
            failure: None,
        };
        self.events
            .run_app(&mut app)
            .map_err(|error| WindowError(error.to_string()))?;
        app.failure.map_or(Ok(()), |failure| Err(WindowError(failure)))
    }
}

struct Pane {
    window: Rc<Window>,
    surface: Surface<OwnedDisplayHandle, Rc<Window>>,
}

struct App<L> {
    place: Place,
    display: Display,
    controls: Arc<Controls>,
    look: L,
    context: Context<OwnedDisplayHandle>,
    pane: Option<Pane>,
    show: Show,
    overlay: bool,
    status: bool,
    help: bool,
    frozen: Option<[Option<Arc<Frame>>; 2]>,
    chosen: usize,
    figures: String,
    picture: Image<Rgb8>,
    notice: Option<String>,
    next_look: Instant,
    wants_to_end: bool,
    failure: Option<String>,
}

impl<L: FnMut(bool) -> Look> App<L> {
    fn open(&self, events: &ActiveEventLoop) -> Result<Pane, String> {
        let attributes = Window::default_attributes()
            .with_title(self.place.title.clone())
            .with_inner_size(LogicalSize::new(1280, 720))
            .with_fullscreen(self.place.full_screen.map(|number| full_screen(events, number)));
        let window = Rc::new(events.create_window(attributes).map_err(|error| error.to_string())?);
        let surface = Surface::new(&self.context, Rc::clone(&window)).map_err(|error| error.to_string())?;
        Ok(Pane { window, surface })
    }

    fn draw(&mut self) -> Result<(), String> {
        let [raw, finished] = self.frozen.clone().unwrap_or_else(|| self.display.newest());
        let there = put_together(
            self.show,
            self.overlay,
            raw.as_deref(),
            finished.as_deref(),
            &mut self.picture,
        );
        let text = self.words();
        let Some(pane) = &mut self.pane else { return Ok(()) };
        let size = pane.window.inner_size();
        let (Some(width), Some(height)) = (NonZeroU32::new(size.width), NonZeroU32::new(size.height)) else {
            return Ok(());
        };
        let said = |error: softbuffer::SoftBufferError| error.to_string();
        pane.surface.resize(width, height).map_err(said)?;
        let mut pixels = pane.surface.buffer_mut().map_err(said)?;
        let size = (size.width as usize, size.height as usize);
        if there {
            fit(&self.picture, &mut pixels, size);
        } else {
            pixels.fill(0);
        }
        if !text.is_empty() {
            words(&text, &mut pixels, size);
        }
        pixels.present().map_err(said)
    }

    fn words(&self) -> String {
        let mut parts = Vec::new();
        if self.help {
            parts.extend(KEYS.iter().map(|(key, _, does)| format!("{key}:{}", does.replace(' ', "_"))));
            parts.push("\n".to_owned());
        }
        if let Some(notice) = &self.notice {
            parts.push(notice.clone());
            parts.push("\n".to_owned());
        }
        if self.frozen.is_some() {
            parts.push("FROZEN".to_owned());
        }
        if self.status {
            parts.push(match self.show {
                Show::Raw => "RAW".to_owned(),
                Show::Enhanced => "ENHANCED".to_owned(),
                Show::Split => "RAW / ENHANCED".to_owned(),
            });
            parts.push(self.figures.clone());
        }
        parts.join(" ")
    }

    fn chosen_stage(&self) -> Option<&'static str> {
        self.controls.stages().nth(self.chosen)
    }

    fn act(&mut self, action: Action, events: &ActiveEventLoop) {
        self.notice = None;
        match action {
            Action::Raw => self.show = Show::Raw,
            Action::Enhanced => self.show = Show::Enhanced,
            Action::Split => self.show = Show::Split,
            Action::Provenance => self.overlay = !self.overlay,
            Action::StatusLine => self.status = !self.status,
            Action::Help => self.help = !self.help,
            Action::Freeze => {
                self.frozen = match self.frozen.take() {
                    Some(_) => None,
                    None => Some(self.display.newest()),
                };
            }
            Action::ChooseStage => {
                self.chosen = (self.chosen + 1) % self.controls.stages().count().max(1);
                self.notice = self.chosen_stage().map(str::to_owned);
            }
            Action::Bypass | Action::Weaker | Action::Stronger => self.change(action),
            Action::Snapshot => self.keep(),
            Action::FullScreen => {
                if let Some(pane) = &self.pane {
                    let wanted = match pane.window.fullscreen() {
                        Some(_) => None,
                        None => Some(full_screen(events, self.place.full_screen.unwrap_or(0))),
                    };
                    pane.window.set_fullscreen(wanted);
                }
            }
            Action::Quit => self.wants_to_end = true,
        }
    }

    /// Change the chosen stage.
    fn change(&mut self, action: Action) {
        let Some(stage) = self.chosen_stage() else { return };
        let Some(switch) = self.controls.switch(self.chosen) else {
            return;
        };
        let (is_off, strength) = (switch.is_bypassed(), switch.strength().unwrap_or(1.0));
        let changed = match action {
            Action::Bypass if is_off => self.controls.resume(stage).map(|()| "on".to_owned()),
            Action::Bypass => self.controls.bypass(stage).map(|()| "off".to_owned()),
            action => {
                let step = if action == Action::Weaker {
                    -STRENGTH_STEP
                } else {
                    STRENGTH_STEP
                };
                let strength = (strength + step).clamp(0.0, 1.0);
                self.controls
                    .set_strength(stage, strength)
                    .map(|()| format!("{:.0} %", 100.0 * strength))
            }
        };
        if let Ok(now) = changed {
            self.notice = Some(format!("{stage} {now}"));
        }
    }

    /// Keep what is shown.
    fn keep(&mut self) {
        if self.picture.width() == 0 {
            return;
        }
        let path = (1..10_000)
            .map(|number| self.place.snapshots.join(format!("snapshot_{number:04}.png")))
            .find(|path| !path.exists());
        let Some(path) = path else { return };
        self.notice = Some(match image_files::write(&path, &self.picture) {
            Ok(()) => {
                tracing::info!("snapshot: {}", path.display());
                format!("kept as {}", path.display())
            }
            Err(error) => {
                tracing::error!("snapshot: {error}");
                "the snapshot could not be written".to_owned()
            }
        });
    }
}

fn full_screen(events: &ActiveEventLoop, number: usize) -> Fullscreen {
    Fullscreen::Borderless(events.available_monitors().nth(number))
}

fn name_of(key: &Key) -> Option<&str> {
    match key {
        Key::Character(text) => Some(text.as_str()),
        Key::Named(NamedKey::Space) => Some("space"),
        Key::Named(NamedKey::Tab) => Some("tab"),
        Key::Named(NamedKey::Escape) => Some("escape"),
        _ => None,
    }
}

impl<L: FnMut(bool) -> Look> ApplicationHandler<Woken> for App<L> {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        match self.open(events) {
            Ok(pane) => self.pane = Some(pane),
            Err(failure) => {
                self.failure = Some(failure);
                events.exit();
            }
        }
    }

    fn user_event(&mut self, _events: &ActiveEventLoop, Woken: Woken) {
        if let Some(pane) = self.pane.as_ref().filter(|_| self.frozen.is_none()) {
            pane.window.request_redraw();
        }
    }

    fn window_event(&mut self, events: &ActiveEventLoop, _window: WindowId, event: WindowEvent) {
        match event {
            WindowEvent::CloseRequested => self.wants_to_end = true,
            WindowEvent::RedrawRequested => {
                if let Err(failure) = self.draw() {
                    self.failure = Some(failure);
                    events.exit();
                }
            }
            WindowEvent::KeyboardInput {
                event:
                    KeyEvent {
                        state: ElementState::Pressed,
                        logical_key,
                        ..
                    },
                ..
            } => {
                if let Some(action) = name_of(&logical_key).and_then(action_of) {
                    self.act(action, events);
                }
                if let Some(pane) = &self.pane {
                    pane.window.request_redraw();
                }
            }
            WindowEvent::Resized(_) => {
                if let Some(pane) = &self.pane {
                    pane.window.request_redraw();
                }
            }
            _ => {}
        }
    }

    fn about_to_wait(&mut self, events: &ActiveEventLoop) {
        #[expect(clippy::disallowed_methods, reason = "the event loop's own deadlines are of this clock")]
        let now = Instant::now();
        if now >= self.next_look {
            self.next_look = now + LOOK_EVERY;
            match (self.look)(self.wants_to_end) {
                Look::Runs(figures) => self.figures = figures,
                Look::Ended => events.exit(),
            }
            if let Some(pane) = &self.pane {
                pane.window.request_redraw();
            }
        }
        events.set_control_flow(ControlFlow::WaitUntil(self.next_look));
    }
}
