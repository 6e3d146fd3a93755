//! The fields of a message, in their order, never beyond its end.

use crate::error::CacheError;

pub(crate) fn malformed(message: &'static str, what: String) -> CacheError {
    CacheError::Malformed { message, what }
}

/// Where a message's fields go.
#[derive(Debug)]
pub struct Writer<'a> {
    rest: &'a mut [u8],
    message: &'static str,
}

impl<'a> Writer<'a> {
    pub(crate) fn new(rest: &'a mut [u8], message: &'static str) -> Self {
        Self { rest, message }
    }

    pub(crate) fn bytes(&mut self, bytes: &[u8]) -> Result<(), CacheError> {
        let rest = std::mem::take(&mut self.rest);
        let Some((field, rest)) = rest.split_at_mut_checked(bytes.len()) else {
            return Err(malformed(self.message, "more fields than it holds".into()));
        };
        field.copy_from_slice(bytes);
        self.rest = rest;
        Ok(())
    }
}

/// Where a message's fields come from.
#[derive(Debug)]
pub struct Reader<'a> {
    rest: &'a [u8],
    message: &'static str,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(rest: &'a [u8], message: &'static str) -> Self {
        Self { rest, message }
    }

    pub(crate) fn bytes<const N: usize>(&mut self) -> Result<[u8; N], CacheError> {
        let (field, rest) = self
            .rest
            .split_first_chunk()
            .ok_or_else(|| malformed(self.message, "too few bytes".into()))?;
        self.rest = rest;
        Ok(*field)
    }

    pub(crate) fn text(&mut self, length: usize) -> Result<String, CacheError> {
        let (field, rest) = self
            .rest
            .split_at_checked(length)
            .ok_or_else(|| malformed(self.message, "too few bytes".into()))?;
        self.rest = rest;
        String::from_utf8(field.to_vec()).map_err(|_| malformed(self.message, "text that is not UTF-8".into()))
    }
}
